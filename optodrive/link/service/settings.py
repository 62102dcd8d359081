"""Settings of the link process, written by the supervisor and read without any model of the configuration."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Self

from optodrive.link.protocol import messages as m
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.session.arming import BoardRequirements, ConfiguredValues
from optodrive.link.session.group_state import OnStageLoss
from optodrive.link.transport.base import PortSettings

OnWebLoss = Literal["dark", "finish"]


@dataclass(frozen=True)
class BoardSettings:
    """Address and requirements of the board of one stage. stage: its name, '' if there is only one."""

    port: PortSettings
    requirements: BoardRequirements
    stage: str = ""

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Return the settings whose fields asdict() wrote."""
        requirements, scale = values["requirements"], values["requirements"]["scale"]
        requirements |= {
            "limits": m.Limits(**requirements["limits"]),
            "scale": WireScale(**scale | {"curve": tuple(map(tuple, scale["curve"]))}),
            "values": ConfiguredValues(**requirements["values"]),
        }
        return cls(PortSettings(**values["port"]), BoardRequirements(**requirements), values["stage"])


@dataclass(frozen=True)
class LinkSettings:
    """Settings of the link process.

    boards: of all stages; skew_max_s: largest error of a board's clock with which a plan may start on several
    socket_path, socket_mode: of the socket on which it listens; capture_path: new file for a capture of the link
    on_web_loss: whether the loss of the web process ends the running plan at once, or lets it run to its end
    on_stage_loss: whether the loss of one of several boards ends the light of all, or the others go on
    """

    boards: tuple[BoardSettings, ...]
    skew_max_s: float
    socket_path: Path
    socket_mode: int = 0o600
    capture_path: Path | None = None
    on_web_loss: OnWebLoss = "dark"
    on_stage_loss: OnStageLoss = "all_dark"

    def to_json(self) -> str:
        """Return the settings as JSON."""
        return json.dumps(asdict(self), default=str)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the settings that to_json() wrote. Raise ValueError, KeyError or TypeError for other text."""
        values: dict[str, Any] = json.loads(text)
        capture_path = values["capture_path"]
        values |= {
            "boards": tuple(BoardSettings.from_dict(board) for board in values["boards"]),
            "socket_path": Path(values["socket_path"]),
            "capture_path": None if capture_path is None else Path(capture_path),
        }
        return cls(**values)
