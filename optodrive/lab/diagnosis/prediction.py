"""Model prediction for a recording's drive, as one vector aligned with the measured one."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from optodrive.core.errors import DivergedError, Unquoted
from optodrive.core.types.arrays import FloatArray
from optodrive.device.servo import simulate_servo
from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, NEVER_S, PIXEL_KINDS, Dataset
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals
from optodrive.physics.stability import check_time_constants
from optodrive.physics.term import BySignal, Term, TermValues
from optodrive.physics.terms import all_terms

BASE_PARAMETERS = ("R", "C", "tau_g", "kappa", "phi")
"""Fitted nominal parameters, all by their logarithms."""
EPSILON = 0.66
"""Absorbed share of the light. With another one, R and C are others in proportion, and nothing else."""
BASE_UNITS = {"R": "K/W", "C": "J/K", "tau_g": "s", "kappa": "m/K", "phi": "N/K"}


@dataclass(frozen=True)
class ParameterPoint:
    """Parameters of a model: logarithms of the base parameters, and terms with their values."""

    base: tuple[float, ...]
    terms: Mapping[str, TermValues]

    def pixel(self, power_factor: float = 1.0) -> Pixel:
        """Return the nominal pixel of the base parameters."""
        r, c, tau_g, kappa, phi = np.exp(np.array(self.base)).tolist()
        return Pixel(r, c, EPSILON * power_factor, tau_g, kappa, phi)


def predict(data: Dataset, point: ParameterPoint, power_factor: float = 1.0, delay_s: float = 0.0) -> FloatArray:
    """Predict all samples [m]. power_factor scales all optical power, delay_s delays all signals.

    Raises DivergedError if a term is too fast for the integrator, a state leaves its range, or a sample is no number.
    """
    out = join_samples(data, simulate_records(data, point, power_factor, delay_s))
    # One sample that is no number would make every χ² of this fit none.
    if not np.isfinite(out).all():
        raise DivergedError(", ".join(point.terms) or "the nominal model", Unquoted("no number"), "finite predictions")
    return out


def simulate_records(
    data: Dataset, point: ParameterPoint, power_factor: float = 1.0, delay_s: float = 0.0
) -> list[FloatArray]:
    """Return the records of all blocks at all times of samples."""
    out = [NEVER_S] * len(data.blocks)
    # All heat is proportional to the absorbed share, so a power factor needs no other pulses.
    pixel = point.pixel(power_factor)
    terms = [(all_terms()[key], values) for key, values in point.terms.items()]
    delays_s = BySignal(*(delay_s + sum(each) for each in _transpose([t.signal_delays(v) for t, v in terms])))
    rates = BySignal(*(sum(each) for each in _transpose([t.signal_rates(v) for t, v in terms])))
    # Before the integration, which would take forever with one too short.
    check_time_constants(point.terms)
    active = ActiveTerms.from_values(point.terms)
    # Repeats then differ, and each is integrated on its own.
    if any(term.varies_between_runs and not term.only_records for term, _ in terms):
        for experiment, numbers in data.experiments:
            first, second, third = (data.blocks[number].sampled_s if number >= 0 else NEVER_S for number in numbers)
            sampled = replace(experiment, t_s=(first, second, third))
            signals = simulate_signals(_time_truly(sampled, rates), pixel, active, delays_s[:3])
            for kind in PIXEL_KINDS:
                if numbers[kind] >= 0:
                    out[numbers[kind]] = signals[kind]
    else:
        for item in data.drive_groups:
            signals = simulate_signals(_time_truly(item.experiment, rates), pixel, active, delays_s[:3])
            for kind, number, rows in item.block_rows:
                out[number] = signals[kind][rows]
    servo = next((servo for term, values in terms if (servo := term.servo(values)) is not None), None)
    for number, block in enumerate(data.blocks):
        commands = data.runs[block.run].commands
        if block.kind in MIRROR_KINDS and commands is not None:
            column = commands[:, 1 + MIRROR_KINDS.index(block.kind)]
            t_s = block.sampled_s / (1.0 + rates.mirrors) - delays_s.mirrors
            out[number] = simulate_servo(commands[:, 0], column, t_s, servo)
    for term, values in terms:
        out = record(data, term, values, out)
    return out


def record(data: Dataset, term: Term, values: TermValues, signals: list[FloatArray]) -> list[FloatArray]:
    """Return the record that instruments make of each block's signal under a term."""
    return [
        term.record(values, BySignal._fields[block.kind], block.sampled_s, signal, run)
        if block.kind in PIXEL_KINDS
        else signal
        for block, run, signal in zip(data.blocks, data.recorded_runs, signals, strict=True)
    ]


def join_samples(data: Dataset, signals: list[FloatArray]) -> FloatArray:
    """Return the samples [m] that the data have of each block's signal."""
    return np.concatenate([signal[block.rows] for block, signal in zip(data.blocks, signals, strict=True)])


def _transpose(rows: list[BySignal]) -> Iterable[tuple[float, ...]]:
    return zip(*rows, strict=True) if rows else [()] * len(BySignal._fields)


def _time_truly(experiment: PixelExperiment, rates: BySignal) -> PixelExperiment:
    """Return the experiment with the true times of its samples."""
    if not any(rates):
        return experiment
    times = experiment.t_s
    true_s = (times[0] / (1.0 + rates[0]), times[1] / (1.0 + rates[1]), times[2] / (1.0 + rates[2]))
    return replace(experiment, t_s=true_s)
