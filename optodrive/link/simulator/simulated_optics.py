"""The optics of a simulated board: galvos, a ground-truth geometry, and the spot sensor on its own port.

The sensor reports where the beam lands, by the lines of SENSOR.md.
"""

import os
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from optodrive.core.quantity import m_to_um
from optodrive.device.config import Config, build_pixel_layout
from optodrive.link.simulator.galvos import SimulatedGalvos
from optodrive.link.simulator.guards import BoardSettings
from optodrive.link.simulator.pixel_recorder import SimulatedPixelRecorder
from optodrive.link.simulator.pseudo_terminal import open_pty
from optodrive.link.simulator.true_geometry import GroundTruthGeometry
from optodrive.physics.thermal_state import ThermalState

PULSE_MEMORY_US = 500_000
"""A pulse older than this no longer counts."""
SPOT_ENERGY_MIN_J = 10e-6
"""Minimum energy of a spot."""
FIELD_MARGIN_M = 6e-3
"""Margin of the field of view beyond the outermost pixels."""


class DetectedPulse(NamedTuple):
    """A pulse on the sensor that ended at at_us."""

    at_us: int
    x_m: float
    y_m: float
    energy_j: float


class SimulatedSpotSensor:
    """Detects pulses with noise at their ground-truth position, and a share of outliers anywhere in the field.

    blind: whether the sensor is covered; has_position_outputs: whether it reads the galvo driver's position outputs
    """

    def __init__(
        self,
        config: Config,
        geometry: GroundTruthGeometry,
        galvos: SimulatedGalvos,
        noise_m: float,
        outlier_share: float,
        has_position_outputs: bool,
        seed: int | np.random.SeedSequence,
    ) -> None:
        layout = build_pixel_layout(config.display)
        self._half_field_m = (
            float(np.abs(layout.x_m).max()) + FIELD_MARGIN_M,
            float(np.abs(layout.y_m).max()) + FIELD_MARGIN_M,
        )
        self._geometry, self._galvos = geometry, galvos
        self._noise_m, self._outlier_share, self._has_position_outputs = noise_m, outlier_share, has_position_outputs
        self._random = np.random.default_rng(seed)
        self._pulses: deque[DetectedPulse] = deque(maxlen=1000)
        self.blind = False

    def record_pulse(self, start_us: int, end_us: int, energy_j: float) -> None:
        """Record a pulse at the mirror angles of its mid-time."""
        x_m, y_m = self._geometry.position_m(*self._galvos.codes((start_us + end_us) // 2))
        if abs(float(x_m)) <= self._half_field_m[0] and abs(float(y_m)) <= self._half_field_m[1] and not self.blind:
            self._pulses.append(DetectedPulse(end_us, float(x_m), float(y_m), energy_j))

    def answer(self, request: str, now_us: int) -> str:
        """Return the line that answers a request line."""
        if request == "spot":
            return self._answer_spot(now_us)
        if request == "mirrors":
            if not self._has_position_outputs:
                return "mirrors none"
            x_rad, y_rad = self._galvos.position_output_rad(now_us)
            return f"mirrors {x_rad:.7f} {y_rad:.7f}"
        return "error unknown request"

    def _answer_spot(self, now_us: int) -> str:
        """Answer with the energy-weighted centroid of the pulses since the last answer, and clear them."""
        pulses = [pulse for pulse in self._pulses if pulse.at_us >= now_us - PULSE_MEMORY_US]
        self._pulses.clear()
        energy_j = sum(glimpse.energy_j for glimpse in pulses)
        if energy_j < SPOT_ENERGY_MIN_J:
            return "spot none"
        x_m = sum(glimpse.x_m * glimpse.energy_j for glimpse in pulses) / energy_j
        y_m = sum(glimpse.y_m * glimpse.energy_j for glimpse in pulses) / energy_j
        if self._random.random() < self._outlier_share:
            x_m, y_m = (self._random.uniform(-half_m, half_m) for half_m in self._half_field_m)
        x_um, y_um = m_to_um(np.array([x_m, y_m]) + self._noise_m * self._random.standard_normal(2))
        return f"spot {x_um:.2f} {y_um:.2f} {m_to_um(self._noise_m):.2f}"


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
