"""Channel model of vibration at the fingertip: how strongly a displacement is felt.

Theory of operation. A vibration is felt by two channels. Each weighs the components of the displacement by its own
threshold, and signals by how many times the weighted amplitude exceeds it. Intensity is the signal of the stronger
channel plus half that of the weaker one (Hollins and Roy 1996, doi 10.3109/08990229609052583). Thresholds follow
Bolanowski et al. 1988 (doi 10.1121/1.397184): the Meissner channel (NP I) falls by 5 dB per octave to some 10 dB re
1 µm at 30 Hz and is flat above; the Pacinian channel falls by 12 dB per octave to -20 dB re 1 µm at 250 Hz for 2.9 cm²,
and rises by 3 dB per halving of the contact area (Verrillo 1963), which makes -4 dB for a pixel of 3 mm diameter.
The figures are round: individuals differ by 5 to 10 dB, and a soft membrane is no rigid contactor.

The stimulus that is felt is the displacement from its first pulse until PERSISTENCE_S after its last.
"""

from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.physics.thermal_state import ThermalState

MEISSNER_MIN_M, MEISSNER_CORNER_HZ, MEISSNER_DB_PER_OCTAVE = 3.2e-6, 30.0, 5.0
PACINIAN_MIN_M, PACINIAN_BEST_HZ, PACINIAN_DB_PER_OCTAVE = 0.63e-6, 250.0, 12.0
FELT_MIN_HZ, FELT_MAX_HZ = 2.0, 500.0
"""Range of frequencies of vibration; slower displacement is pressure."""
WEAKER_SHARE = 0.5
PERSISTENCE_S, TRACE_STEP_S = 0.1, 1e-3


class ChannelSignals(NamedTuple):
    """Signals of both channels: amplitude above threshold in units of the threshold, 0 below it."""

    meissner: float
    pacinian: float

    @property
    def intensity(self) -> float:
        """Perceived intensity: the stronger signal plus half the weaker one, in units of a threshold."""
        return max(self) + WEAKER_SHARE * min(self)


def compute_threshold_m(frequency_hz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the peak displacements at the thresholds of the Meissner and the Pacinian channel, m, [n] each."""
    below = np.maximum(0.0, np.log2(MEISSNER_CORNER_HZ / frequency_hz))
    meissner_m = MEISSNER_MIN_M * 10.0 ** (MEISSNER_DB_PER_OCTAVE * below / 20.0)
    away = np.abs(np.log2(PACINIAN_BEST_HZ / frequency_hz))
    pacinian_m = PACINIAN_MIN_M * 10.0 ** (PACINIAN_DB_PER_OCTAVE * away / 20.0)
    return meissner_m, pacinian_m


def compute_excitations(displacement_m: FloatArray, dt_s: float) -> tuple[float, float]:
    """Return the weighted amplitudes of a displacement [n] at steps of dt_s, in units of each channel's threshold."""
    count = len(displacement_m)
    frequency_hz = np.asarray(np.fft.rfftfreq(count, dt_s), dtype=np.float64)
    is_felt = (frequency_hz >= FELT_MIN_HZ) & (frequency_hz <= FELT_MAX_HZ)
    # Without the mean: a membrane that stands is pressure, which these channels do not signal.
    amplitude_m = 2.0 / count * np.abs(np.fft.rfft(displacement_m - displacement_m.mean()))[is_felt]
    meissner_m, pacinian_m = compute_threshold_m(frequency_hz[is_felt])
    meissner, pacinian = (float(np.sqrt(np.sum((amplitude_m / m) ** 2))) for m in (meissner_m, pacinian_m))
    return meissner, pacinian


def compute_pulse_excitations(heat: ThermalState, pulses: FloatArray, pixel: int) -> tuple[float, float]:
    """Return the weighted amplitudes of a stimulus on one pixel, in units of each channel's threshold.

    pulses: [n, 4] start_s, width_s, power_w, pixel in order. heat: before the first of them.
    """
    first_s, duration_s = pulses[0, 0], pulses[-1, 0] + pulses[-1, 1] + PERSISTENCE_S - pulses[0, 0]
    count = round(duration_s / TRACE_STEP_S)
    # Whole steps over the whole duration: a cut period would leak into other frequencies.
    dt_s = duration_s / count
    return compute_excitations(heat.simulate_displacement_m(pulses, pixel, first_s + dt_s * np.arange(count)), dt_s)


def compute_signals(excitations: tuple[float, float]) -> ChannelSignals:
    """Return the channels' signals for weighted amplitudes in units of their thresholds."""
    meissner, pacinian = excitations
    return ChannelSignals(max(0.0, meissner - 1.0), max(0.0, pacinian - 1.0))


def compute_intensity(excitations: FloatArray) -> FloatArray:
    """Return the perceived intensity [n] for the weighted amplitudes of both channels, [n, 2]."""
    signals = np.maximum(excitations - 1.0, 0.0)
    return np.asarray(signals.max(axis=1) + WEAKER_SHARE * signals.min(axis=1), dtype=np.float64)
