"""Heights of frames and trains that are felt with a requested intensity.

Theory of operation. `intensity` is the perceived intensity of the channel model (`optodrive.physics.sensation`), in
units of a threshold: 0 is the threshold itself, and twice the number is felt twice as strong. It depends on the whole
course of the displacement: of a frame, on the single pulse that raises a cold pixel to its height; of a train, on the
pulses of its first second from the cold state, as the planner shapes them.

Height and excitation of both channels are tabulated on the nominal pixel, from a low height to the largest one. A pixel
of gain g moves g times as far by the same pulse: it has g times the excitation at g times the height. Intensity rises
with the height of a single pulse. That of a train falls again where its pulses fill the period, because the membrane
then hardly falls between them; the table ends at the maximum. So every intensity below it has one height.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import floor

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.quantity import format_quantity, m_to_um, um_to_m
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.stimuli import HeightTrain
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.pixel_map import load_pixel_map, remove_pixel_map
from optodrive.device.sensitivity_map import load_sensitivity_map, replace_sensitivity_map
from optodrive.physics.parameters import load_parameters
from optodrive.physics.pulse_for_height import DriveRange
from optodrive.physics.sensation import FELT_MAX_HZ, compute_intensity, compute_pulse_excitations
from optodrive.physics.thermal_state import ThermalState, build_cold_state
from optodrive.planning.scheduler.periodic_pulses import (
    build_pulse_recipe,
    compute_next_pulse,
    compute_steady_state,
    limit_pulse_width,
)

HEIGHT_SPAN, FRAME_SAMPLES, TRAIN_SAMPLES = 300.0, 48, 32
"""Largest over smallest simulated height of a table, and their number for frames and for trains."""
PROPORTIONAL_SPAN, INTERPOLATED = 1000.0, 2048
"""Factor by which a table goes on below the simulated heights, and number of its heights."""
BELOW_MAX = 1.0 - 1e-9
"""Factor of the largest height, which rounding then does not exceed."""
HEIGHT_DECIMALS = 9
"""Decimals of a height in µm, with which FRAMES.json is written."""
TRAIN_FELT_S = 1.0
"""Time from the start of a train that counts, s."""
PERIOD_MIN_S = 1.0 / FELT_MAX_HZ
"""Smallest period of a train by intensity: a faster vibration is not felt."""
TRAIN_TABLES_MAX = 16
"""Largest number of different periods and durations of trains with an intensity in a sequence."""


@dataclass(frozen=True, eq=False)
class ExcitationTable:
    """Excitations of the channels [n, 2] by increasing height of the nominal pixel [n]."""

    height_m: FloatArray
    excitations: FloatArray

    @classmethod
    def tabulate(cls, max_m: float, samples: int, excite: Callable[[float], tuple[float, float]]) -> "ExcitationTable":
        """Interpolate excitations between heights up to max_m, and end at their maximum.

        Below the smallest of these heights they are proportional to the height.
        """
        height_m = np.geomspace(max_m / HEIGHT_SPAN, max_m, samples)
        excitations = np.array([excite(each_m) for each_m in height_m.tolist()])
        height_m = np.append(height_m[0] / PROPORTIONAL_SPAN, height_m)
        excitations = np.vstack([excitations[0] / PROPORTIONAL_SPAN, excitations])
        fine_m = np.geomspace(height_m[0], max_m, INTERPOLATED)
        columns = [np.exp(np.interp(np.log(fine_m), np.log(height_m), np.log(each))) for each in excitations.T]
        fine = np.column_stack(columns)
        end = int(np.argmax(fine.max(axis=1))) + 1
        return cls(fine_m[:end], fine[:end])

    def compute_max(self, factor: FloatArray) -> FloatArray:
        """Return the largest intensities of pixels whose excitations are `factor` [n] times the nominal one, [n]."""
        return compute_intensity(factor[:, None] * self.excitations[-1])

    def solve_m(self, intensity: FloatArray, factor: FloatArray) -> FloatArray:
        """Return the nominal heights of intensities [n] above 0, at most those of `compute_max`, by bisection."""
        low, high = np.zeros(len(intensity), dtype=np.int64), np.full(len(intensity), len(self.height_m) - 1)
        while (high - low > 1).any():
            middle = (low + high) // 2
            is_reached = compute_intensity(factor[:, None] * self.excitations[middle]) >= intensity
            low, high = np.where(is_reached, low, middle), np.where(is_reached, middle, high)
        felt_low, felt_high = (compute_intensity(factor[:, None] * self.excitations[row]) for row in (low, high))
        share = (intensity - felt_low) / (felt_high - felt_low)
        return np.asarray(self.height_m[low] + share * (self.height_m[high] - self.height_m[low]), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class NominalDrive:
    """The nominal pixel, cold, and the laser's pulses by which its tables are made."""

    cold: ThermalState
    drive: DriveRange
    pulse_gap_s: float

    @cached_property
    def frame_table(self) -> ExcitationTable:
        """Table of single pulses."""
        cold, drive = self.cold, self.drive

        def excite(height_m: float) -> tuple[float, float]:
            periods, duty = cold.solve_pulse(0, 0.0, height_m, drive) or (0, 0.0)
            pulse = np.array([[0.0, periods * drive.period_s, duty * drive.max_power_w, 0.0]])
            return compute_pulse_excitations(cold, pulse, 0)

        return ExcitationTable.tabulate(BELOW_MAX * float(cold.max_displacement_m(drive)[0]), FRAME_SAMPLES, excite)

    def tabulate_train(self, period_s: float, duration_s: float) -> ExcitationTable:
        """Tabulate a train by height."""
        drive = limit_pulse_width(self.drive, round(1e6 * (period_s - self.pulse_gap_s)))
        longest = HeightTrain(0, 0.0, duration_s, period_s, 1.0)
        max_m = BELOW_MAX * compute_steady_state(longest, self.cold, drive, drive.max_periods, 1.0).peak_m
        return ExcitationTable.tabulate(
            max_m,
            TRAIN_SAMPLES,
            lambda height_m: self._excite_by_train(HeightTrain(0, 0.0, duration_s, period_s, height_m), drive),
        )

    def _excite_by_train(self, train: HeightTrain, drive: DriveRange) -> tuple[float, float]:
        """Return the excitations by the pulses that a train alone gets on a cold display."""
        recipe, heat, pulses = build_pulse_recipe(train, self.cold, drive, "train"), self.cold.copy(), []
        for start_s in train.pulse_starts_s().tolist():
            shape = compute_next_pulse(train, recipe, heat, start_s, drive)
            if shape is not None:
                pulses.append((start_s, shape[0] * drive.period_s, shape[1] * drive.max_power_w, train.pixel))
                start, width, power = (np.array([each]) for each in pulses[-1][:3])
                heat.apply_pulses(np.array([train.pixel]), start, width, power)
        return compute_pulse_excitations(self.cold, np.array(pulses, dtype=np.float64), train.pixel)


@lru_cache(maxsize=8)
def _build_nominal(config: Config, _parameters: str) -> NominalDrive:
    """Build the nominal pixel and the pulses of a configuration without maps.

    _parameters: content of the parameter set, by which a changed file is told
    """
    # A pixel may get any stage that reaches it, also the one with the least power.
    weakest = min(config.list_stage_configs(), key=lambda stage: stage.laser.max_power_w)
    drive = DriveRange.from_config(weakest)
    cold = build_cold_state(config, load_parameters(config.pixel_model.parameters))
    return NominalDrive(cold, drive, config.limits.pulse_gap_min_s)


@lru_cache(maxsize=4 * TRAIN_TABLES_MAX)
def _tabulate_train(nominal: NominalDrive, period_s: float, duration_s: float) -> ExcitationTable:
    return nominal.tabulate_train(period_s, duration_s)


class IntensityModel:
    """Converts intensities to heights for a configured display and the person of its sensitivity map, if it names one.

    Nothing is computed before the first conversion, and tables of earlier models of the same display are used.
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self._trains: set[tuple[float, float]] = set()

    def solve_targets_m(self, intensity: FloatArray, where: str) -> FloatArray:
        """Return the peak heights of single pulses, m, [p], for intensities [p], 0 where that is 0.

        Raises InputError (target_unreachable) for an intensity beyond the longest pulse at full power.
        """
        reach = (
            f"the intensity of the longest pulse ({format_quantity(self._config.limits.pulse_width_max_s, 's')} "
            f"at {format_quantity(self._nominal.drive.max_power_w, 'W')})"
        )
        pixels, target_m = np.flatnonzero(intensity), np.zeros(len(intensity))
        places = (f"{where}.{pixel}" for pixel in pixels.tolist())
        target_m[pixels] = self._solve_m(self._nominal.frame_table, pixels, intensity[pixels], places, reach)
        return target_m

    def solve_train_m(self, pixel: int, period_s: float, duration_s: float, intensity: float, where: str) -> float:
        """Return the height of a train's pulses, m, for its intensity.

        Raises InputError (target_unreachable, too_many).
        """
        if period_s < PERIOD_MIN_S:
            expected = f"a period of at least {format_quantity(PERIOD_MIN_S, 's')}: a faster vibration is not felt"
            raise InputError(where, intensity, expected, code="target_unreachable")
        key = (period_s, min(duration_s, TRAIN_FELT_S))
        self._trains.add(key)
        if len(self._trains) > TRAIN_TABLES_MAX:
            expected = f"at most {TRAIN_TABLES_MAX} different periods and durations of trains with an intensity"
            raise InputError(where, intensity, expected, code="too_many")
        reach = f"the largest of pulses every {format_quantity(period_s, 's', 4)}"
        table = _tabulate_train(self._nominal, *key)
        return float(self._solve_m(table, np.array([pixel]), np.array([intensity]), [where], reach)[0])

    def _solve_m(
        self, table: ExcitationTable, pixels: IntArray, intensity: FloatArray, places: Iterable[str], reach: str
    ) -> FloatArray:
        """Return the heights of intensities at pixels [n], m. Raise InputError for the first that is unreachable."""
        gain = self._gain[pixels]
        factor = gain * self._sensitivity[pixels]
        max_intensity = table.compute_max(factor)
        beyond = np.flatnonzero(intensity > max_intensity)
        if len(beyond):
            first = int(beyond[0])
            expected = f"at most {floor(100.0 * max_intensity[first]) / 100.0:g}, {reach}"
            raise InputError(list(places)[first], float(intensity[first]), expected, code="target_unreachable")
        height_um = np.round(m_to_um(gain * table.solve_m(intensity, factor)), HEIGHT_DECIMALS)
        return np.asarray(um_to_m(height_um), dtype=np.float64)

    @cached_property
    def _nominal(self) -> NominalDrive:
        bare = replace_sensitivity_map(remove_pixel_map(self._config), None)
        return _build_nominal(bare, load_parameters(bare.pixel_model.parameters).model_dump_json())

    @cached_property
    def _gain(self) -> FloatArray:
        """Displacement of each pixel over the nominal pixel's, [p]. A dead pixel has a gain, too."""
        known = load_pixel_map(self._config)
        return np.ones(len(build_pixel_layout(self._config.display))) if known is None else known.gain

    @cached_property
    def _sensitivity(self) -> FloatArray:
        """Felt amplitude of each pixel over the channel model's, [p]."""
        known = load_sensitivity_map(self._config)
        return np.ones(len(self._gain)) if known is None else known.sensitivity
