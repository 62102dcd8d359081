"""What stands around a simulated board: mirrors, a geometry nobody is told, and the spot sensor on its own port."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.device.config import Config
from optodrive.link.simulator.board_limits import BoardSettings
from optodrive.link.simulator.galvos import Mirrors
from optodrive.link.simulator.pseudo_terminal import open_pty
from optodrive.link.simulator.spot_sensor import SpotSensor
from optodrive.link.simulator.true_geometry import Truth

READ_MAX = 1024
LINE_MAX = 64


class Bench:
    """The sensor's process side: it follows the board's log, and answers on its own pty."""

    def __init__(
        self,
        link: Path,
        config: Config,
        settings: BoardSettings,
        geometry: int,
        noise_m: float = 10e-6,
        false_share: float = 0.02,
        outputs: bool = True,
    ) -> None:
        mirrors_seed, sensor_seed = np.random.SeedSequence(geometry).spawn(2)  # apart from what the truth is drawn from
        self.mirrors = Mirrors(config, mirrors_seed)
        truth = Truth.drawn(geometry, config)
        self._sensor = SpotSensor(config, truth, self.mirrors, noise_m, false_share, outputs, sensor_seed)
        self._full_w = settings.limits.full_power_uw * 1e-6
        self._link = link
        self._line = b""
        self._master: int | None = open_pty(link)

    def note(self, event: dict[str, Any]) -> None:
        """Take over what the board logs."""
        if event["event"] == "pulse":
            width_s = (event["off_us"] - event["on_us"]) * 1e-6
            self._sensor.saw(event["on_us"], event["off_us"], event["duty"] / 65535 * self._full_w * width_s)

    def serve(self, now_us: int) -> None:
        """Answer what was asked."""
        if self._master is None:
            return
        with suppress(OSError):  # nothing there, or no host has the port open
            self._line += os.read(self._master, READ_MAX)
        *lines, self._line = self._line.split(b"\n")
        self._line = self._line[-LINE_MAX:]
        for line in lines:
            answer = self._sensor.answer(line.decode("ascii", "replace").strip(), now_us)
            with suppress(OSError):
                os.write(self._master, answer.encode("ascii") + b"\n")

    def break_down(self, how: str, at_us: int) -> None:
        """`stick_x`, `stick_y`, `invert_readback`, `blind_sensor`, `unplug_sensor`."""
        if how in ("stick_x", "stick_y"):
            self.mirrors.stick("xy".index(how[-1]), at_us)
        elif how == "invert_readback":
            self.mirrors.inverted = True
        elif how == "blind_sensor":
            self._sensor.blind = True
        elif how == "unplug_sensor":
            self.close()
        else:
            raise ValueError(how)

    def close(self) -> None:
        """The port vanishes."""
        if self._master is not None:
            os.close(self._master)
            self._master = None
            self._link.unlink(missing_ok=True)
