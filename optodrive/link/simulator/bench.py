"""What stands around a simulated board: mirrors, a geometry nobody is told, and the spot sensor on its own port."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.device.config import Config
from optodrive.link.simulator.board_limits import BoardSettings
from optodrive.link.simulator.galvos import SimulatedGalvos
from optodrive.link.simulator.pseudo_terminal import open_pty
from optodrive.link.simulator.spot_sensor import SimulatedSpotSensor
from optodrive.link.simulator.true_geometry import GroundTruthGeometry

READ_MAX = 1024
LINE_MAX = 64


class SimulatedOptics:
    """The sensor's process side: it follows the board's log, and answers on its own pty."""

    def __init__(
        self,
        link: Path,
        config: Config,
        settings: BoardSettings,
        seed: int,
        noise_m: float = 10e-6,
        outlier_share: float = 0.02,
        has_position_outputs: bool = True,
    ) -> None:
        mirrors_seed, sensor_seed = np.random.SeedSequence(seed).spawn(2)  # apart from what the truth is drawn from
        self.mirrors = SimulatedGalvos(config, mirrors_seed)
        truth = GroundTruthGeometry.sample(seed, config)
        self._sensor = SimulatedSpotSensor(
            config, truth, self.mirrors, noise_m, outlier_share, has_position_outputs, sensor_seed
        )
        self._full_w = settings.limits.full_power_uw * 1e-6
        self._link = link
        self._buffer = b""
        self._master: int | None = open_pty(link)

    def on_log_event(self, event: dict[str, Any]) -> None:
        """Take over what the board logs."""
        if event["event"] == "pulse":
            width_s = (event["off_us"] - event["on_us"]) * 1e-6
            self._sensor.record_pulse(event["on_us"], event["off_us"], event["duty"] / 65535 * self._full_w * width_s)

    def answer_requests(self, now_us: int) -> None:
        """Answer what was asked."""
        if self._master is None:
            return
        with suppress(OSError):  # nothing there, or no host has the port open
            self._buffer += os.read(self._master, READ_MAX)
        *lines, self._buffer = self._buffer.split(b"\n")
        self._buffer = self._buffer[-LINE_MAX:]
        for request in lines:
            answer = self._sensor.answer(request.decode("ascii", "replace").strip(), now_us)
            with suppress(OSError):
                os.write(self._master, answer.encode("ascii") + b"\n")

    def inject_fault(self, kind: str, at_us: int) -> None:
        """`stick_x`, `stick_y`, `invert_readback`, `blind_sensor`, `unplug_sensor`."""
        if kind in ("stick_x", "stick_y"):
            self.mirrors.stick("xy".index(kind[-1]), at_us)
        elif kind == "invert_readback":
            self.mirrors.readback_inverted = True
        elif kind == "blind_sensor":
            self._sensor.blind = True
        elif kind == "unplug_sensor":
            self.close()
        else:
            raise ValueError(kind)

    def close(self) -> None:
        """The port vanishes."""
        if self._master is not None:
            os.close(self._master)
            self._master = None
            self._link.unlink(missing_ok=True)
