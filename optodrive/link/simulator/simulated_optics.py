"""The optics of a simulated board: galvos, a ground-truth geometry, and the spot sensor on its own port."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.device.config import Config
from optodrive.link.simulator.board_limits import BoardSettings
from optodrive.link.simulator.galvos import SimulatedGalvos
from optodrive.link.simulator.pixel_recorder import SimulatedPixelRecorder
from optodrive.link.simulator.pseudo_terminal import open_pty
from optodrive.link.simulator.spot_sensor import SimulatedSpotSensor
from optodrive.link.simulator.true_geometry import GroundTruthGeometry
from optodrive.physics.thermal_state import ThermalState

READ_MAX = 1024
LINE_MAX = 64
PIXEL_REQUESTS = ("signals", "record", "samples")


class SimulatedOptics:
    """Galvos and spot sensor that follow the board's log. The sensor answers on its own pty.

    cold_state: of a display under the beam, whose pixels the sensor then records; None for a sensor of spots only
    """

    def __init__(
        self,
        link: Path,
        config: Config,
        settings: BoardSettings,
        seed: int,
        noise_m: float = 10e-6,
        outlier_share: float = 0.02,
        has_position_outputs: bool = True,
        cold_state: ThermalState | None = None,
    ) -> None:
        galvos_seed, sensor_seed, recorder_seed = np.random.SeedSequence(seed).spawn(3)  # independent of the geometry
        self.galvos = SimulatedGalvos(config, galvos_seed)
        truth = GroundTruthGeometry.sample(seed, config)
        self._sensor = SimulatedSpotSensor(
            config, truth, self.galvos, noise_m, outlier_share, has_position_outputs, sensor_seed
        )
        self._recorder = (
            None
            if cold_state is None
            else SimulatedPixelRecorder(config, truth, self.galvos, cold_state, recorder_seed)
        )
        self._full_w = settings.limits.full_power_uw * 1e-6
        self._link = link
        self._buffer = b""
        self._master: int | None = open_pty(link)

    def on_log_event(self, event: dict[str, Any]) -> None:
        """Apply an event of the board's log."""
        if event["event"] == "pulse":
            width_s = (event["off_us"] - event["on_us"]) * 1e-6
            power_w = event["duty"] / 65535 * self._full_w
            self._sensor.record_pulse(event["on_us"], event["off_us"], power_w * width_s)
            if self._recorder is not None:
                self._recorder.record_pulse(event["on_us"], event["off_us"], power_w)

    def answer_requests(self, now_us: int) -> None:
        """Answer the requests that have arrived."""
        if self._master is None:
            return
        with suppress(OSError):  # empty, or no host has the port open
            self._buffer += os.read(self._master, READ_MAX)
        *lines, self._buffer = self._buffer.split(b"\n")
        self._buffer = self._buffer[-LINE_MAX:]
        for request in lines:
            answer = self._answer(request.decode("ascii", "replace").strip(), now_us)
            with suppress(OSError):
                os.write(self._master, answer.encode("ascii") + b"\n")

    def _answer(self, request: str, now_us: int) -> str:
        if request.split(" ")[0] not in PIXEL_REQUESTS:
            return self._sensor.answer(request, now_us)
        if self._recorder is None:
            return "signals none" if request == "signals" else "error no pixel is recorded"
        return self._recorder.answer(request, now_us)

    def inject_fault(self, kind: str, at_us: int) -> None:
        """Inject a fault: `stick_x`, `stick_y`, `invert_readback`, `blind_sensor` or `unplug_sensor`."""
        if kind in ("stick_x", "stick_y"):
            self.galvos.stick("xy".index(kind[-1]), at_us)
        elif kind == "invert_readback":
            self.galvos.readback_inverted = True
        elif kind == "blind_sensor":
            self._sensor.blind = True
        elif kind == "unplug_sensor":
            self.close()
        else:
            raise ValueError(kind)

    def close(self) -> None:
        """Close and remove the port."""
        if self._master is not None:
            os.close(self._master)
            self._master = None
            self._link.unlink(missing_ok=True)
