"""Settings of the link process, written by the supervisor and read without any model of the configuration."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Self

from optodrive.link.protocol import messages as m
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.session.board_requirements import BoardRequirements, ConfiguredValues
from optodrive.link.transport.port_settings import PortSettings

OnWebLoss = Literal["dark", "finish"]


@dataclass(frozen=True)
class LinkSettings:
    """Settings of the link process.

    socket_path, socket_mode: of the socket on which it listens; capture_path: new file for a capture of the link
    on_web_loss: whether the loss of the web process ends the running plan at once, or lets it run to its end
    """

    port: PortSettings
    requirements: BoardRequirements
    socket_path: Path
    socket_mode: int = 0o600
    capture_path: Path | None = None
    on_web_loss: OnWebLoss = "dark"

    def to_json(self) -> str:
        """Return the settings as JSON."""
        return json.dumps(asdict(self), default=str)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the settings that to_json() wrote. Raise ValueError, KeyError or TypeError for other text."""
        values: dict[str, Any] = json.loads(text)
        requirements = values["requirements"]
        requirements |= {
            "limits": m.Limits(**requirements["limits"]),
            "scale": WireScale(**requirements["scale"]),
            "values": ConfiguredValues(**requirements["values"]),
        }
        capture_path = values["capture_path"]
        values |= {
            "port": PortSettings(**values["port"]),
            "requirements": BoardRequirements(**requirements),
            "socket_path": Path(values["socket_path"]),
            "capture_path": None if capture_path is None else Path(capture_path),
        }
        return cls(**values)
