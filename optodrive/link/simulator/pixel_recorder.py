"""Simulated recorder of one pixel: temperature and displacement of a hidden display, by the lines of SENSOR.md.

The instruments are a thermal camera, an interferometer and a load cell, with their noise.
"""

from collections import deque
from typing import NamedTuple

import numpy as np

from optodrive.core.quantity import ZERO_CELSIUS_K
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Measurement, PixelTrace, Run, Signal
from optodrive.device.config import Config, build_pixel_layout
from optodrive.link.simulator.galvos import SimulatedGalvos
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
