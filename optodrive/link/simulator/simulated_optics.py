"""The optics of a simulated board: galvos, a ground-truth geometry, and the spot sensor on its own port.

The sensor reports where the beam lands, by the lines of SENSOR.md.
"""

import os
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from optodrive.core.laser_power import compute_power_w
from optodrive.core.quantity import ZERO_CELSIUS_K, m_to_um
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Measurement, PixelTrace, Run, Signal
from optodrive.device.config import Config, build_pixel_layout
from optodrive.link.simulator.galvos import SimulatedGalvos
from optodrive.link.simulator.guards import BoardSettings
from optodrive.link.simulator.pseudo_terminal import open_pty
from optodrive.link.simulator.true_geometry import GroundTruthGeometry
from optodrive.physics.thermal_state import ThermalState

INSTRUMENT_SIGMA = {"absorber_temperature_K": 1.0, "displacement_m": 0.25e-6, "force_N": 0.1e-3}
"""Standard deviation of each instrument's noise."""


def measure(
    trace: PixelTrace,
    pulses: FloatArray,
    ambient_k: float,
    bridge_width_m: float,
    noise: float,
    seed: int | np.random.Generator,
    aim_m: FloatArray | None = None,
) -> Measurement:
    """Measure a trace: one run per pixel, named after it. noise: factor on each instrument's noise.

    pulses: [n, 4] as in a recording
    aim_m: [2, pixels of the display] beam aim relative to each pixel's centre, m; None for the centre
    """
    rng = np.random.default_rng(seed)
    runs = []
    for column, pixel in enumerate(trace.pixel.tolist()):
        exact = {
            "absorber_temperature_K": ambient_k + trace.absorber_k[:, column],
            "displacement_m": trace.displacement_m[:, column],
            "force_N": trace.force_n[:, column],
        }
        signals = {
            name: Signal(
                pixel=pixel,
                t_s=trace.t_s,
                value=values + noise * INSTRUMENT_SIGMA[name] * rng.standard_normal(len(values)),
                sigma=noise * INSTRUMENT_SIGMA[name] if noise else None,
            )
            for name, values in exact.items()
        }
        attributes: dict[str, str | float] = {"bridge_width_m": bridge_width_m, "sample": "simulated"}
        if aim_m is not None:
            attributes |= {"aim_x_m": float(aim_m[0, pixel]), "aim_y_m": float(aim_m[1, pixel])}
        runs.append(Run(f"pixel-{pixel}", ambient_k, pulses, signals, attributes))
    return Measurement(tuple(runs))


SIGNALS = ("absorber_temperature_K", "displacement_m")
SAMPLES_MAX = 4000
SAMPLES_PER_LINE = 40
PRE_LIGHT_US = 20_000
"""Time that is recorded before the first light."""
PULSE_MEMORY = 2000
"""Pulses that the recorder's display remembers; the oldest ones are cold by then."""


class _Request(NamedTuple):
    """A recording that was asked for at a time."""

    since_us: int
    pixel: int
    samples: int
    step_us: int


class SimulatedPixelRecorder:
    """Records a pixel from the first light after a request on. Light counts as far as it lands on an absorber."""

    def __init__(
        self,
        config: Config,
        geometry: GroundTruthGeometry,
        galvos: SimulatedGalvos,
        cold_state: ThermalState,
        seed: int | np.random.SeedSequence,
    ) -> None:
        self._config, self._geometry, self._galvos, self._cold = config, geometry, galvos, cold_state
        self._layout = build_pixel_layout(config.display)
        self._random = np.random.default_rng(seed)
        self._pulses: deque[tuple[int, int, float, int]] = deque(maxlen=PULSE_MEMORY)
        self._request: _Request | None = None
        self._recorded: dict[str, FloatArray] = {}
        self._cold.simulate_traces(np.zeros((0, 4)), [0], np.linspace(0.0, 1e-3, 2))  # compiles, before the board runs

    def record_pulse(self, start_us: int, end_us: int, power_w: float) -> None:
        """Heat the pixel on which a pulse lands."""
        x_m, y_m = (float(item) for item in self._geometry.position_m(*self._galvos.codes((start_us + end_us) // 2)))
        pixel = int(np.argmin(np.hypot(self._layout.x_m - x_m, self._layout.y_m - y_m)))
        laser, display = self._config.laser, self._config.display
        share = _compute_overlap(x_m - self._layout.x_m[pixel], laser.focus_width_m, display.absorber_width_m)
        share *= _compute_overlap(y_m - self._layout.y_m[pixel], laser.focus_height_m, display.absorber_height_m)
        self._pulses.append((start_us, end_us, share * power_w, pixel))

    def answer(self, request: str, now_us: int) -> str:
        """Return the line that answers a request line."""
        word, *rest = request.split()
        try:
            numbers = [int(item) for item in rest]
        except ValueError:
            return "error numbers expected"
        if word == "record" and len(numbers) == 3:
            return self._answer_record(_Request(now_us, *numbers))
        if word == "samples" and len(numbers) == 2:
            return self._answer_samples(numbers[0], numbers[1], now_us)
        return f"signals {' '.join(SIGNALS)}" if request == "signals" else "error unknown request"

    def _answer_record(self, request: _Request) -> str:
        if not 0 <= request.pixel < len(self._layout) or not 2 <= request.samples <= SAMPLES_MAX or request.step_us < 1:
            return "error out of range"
        self._request, self._recorded = request, {}
        return f"record {request.samples}"

    def _answer_samples(self, signal: int, first: int, now_us: int) -> str:
        if self._request is None or not 0 <= signal < len(SIGNALS) or not 0 <= first < self._request.samples:
            return "error out of range"
        if not self._recorded:
            self._record(self._request, now_us)
        if not self._recorded:
            return "samples none"
        values = self._recorded[SIGNALS[signal]][first : first + SAMPLES_PER_LINE]
        return f"samples {' '.join(f'{value:.7g}' for value in values)}"

    def _record(self, request: _Request, now_us: int) -> None:
        """Compute the recording, once its last sample is past."""
        light_us = next((pulse[0] for pulse in self._pulses if pulse[0] >= request.since_us), None)
        if light_us is None or now_us < light_us - PRE_LIGHT_US + request.samples * request.step_us:
            return
        zero_us = min(self._pulses[0][0], light_us - PRE_LIGHT_US)
        pulses = np.array(
            [((on - zero_us) * 1e-6, (off - on) * 1e-6, power_w, pixel) for on, off, power_w, pixel in self._pulses]
        )
        t_s: FloatArray = 1e-6 * (
            light_us - PRE_LIGHT_US - zero_us + request.step_us * np.arange(float(request.samples))
        )
        trace = self._cold.simulate_traces(pulses, [request.pixel], t_s)
        ambient_k = self._config.ambient_c + ZERO_CELSIUS_K
        width_m = self._config.display.bridge_width_m
        (run,) = measure(trace, pulses, ambient_k, width_m, 1.0, self._random).runs
        self._recorded = {name: run.signals[name].value for name in SIGNALS}


def _compute_overlap(offset_m: float, focus_m: float, absorber_m: float) -> float:
    """Return the share of a focus that lies on an absorber, along one axis."""
    low_m, high_m = max(offset_m - 0.5 * focus_m, -0.5 * absorber_m), min(offset_m + 0.5 * focus_m, 0.5 * absorber_m)
    return max(0.0, high_m - low_m) / focus_m


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
        self._curve = config.laser.curve
        self._full_w = settings.limits.full_power_uw * 1e-6
        self._link = link
        self._buffer = b""
        self._master: int | None = open_pty(link)

    def on_log_event(self, event: dict[str, Any]) -> None:
        """Apply an event of the board's log."""
        if event["event"] == "pulse":
            width_s = (event["off_us"] - event["on_us"]) * 1e-6
            power_w = float(compute_power_w(np.array(event["duty"] / 65535), self._full_w, self._curve))
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
