"""Small synthetic recordings for unit tests of the diagnosis, made with the package's own pixel model."""

from dataclasses import replace

import numpy as np

from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals
from optodrive.physics.term import BySignal
from optodrive.physics.terms import discover_terms

PIXEL = Pixel(180.0, 100e-6, 0.66, 3e-3, 4e-6, 2.3e-4)
AMBIENT_K = 293.15
SLACK_M = 4e-5
GROUPS = {
    "short": [(0.02, 0.005, 2.45, 0.0)],
    "weak": [(0.02, 0.06, 0.8, 0.0)],
    "middle": [(0.02, 0.06, 1.6, 0.0)],
    "strong": [(0.02, 0.06, 2.45, 0.0)],
    "train": [(0.02 + 0.06 * k, 0.02, 2.45, 0.0) for k in range(15)],
}
SIGNALS = (("absorber_temperature_K", 0.3), ("displacement_m", 2e-6))


def lab(seed, terms, groups=tuple(GROUPS), repeats=3, rate=1000.0, noise=1.0, coupling="DC"):
    """Return a recording of these groups with white and coloured noise, jitters and a few missing samples.

    coupling: as the runs state, if they do
    noise: factor on noise and jitters; 0 gives repeats that are equal to the last digit, without missing samples
    """
    rng = np.random.default_rng(seed)
    parts = [BySignal(), *(discover_terms()[key].signal_delays(values) for key, values in terms.items())]
    delays = BySignal(*(sum(column) for column in zip(*parts, strict=True)))
    runs = []
    for name in groups:
        pulses = np.array(GROUPS[name])
        until_s = float((pulses[:, 0] + pulses[:, 1]).max()) + 0.1
        t_s = np.arange(0.0, until_s, 1.0 / rate) + 0.5 / rate
        attributes = {"group": name} | ({"coupling": coupling} if coupling else {})
        for _ in range(repeats):
            real = pulses.copy()
            real[:, 2] *= np.exp(noise * 0.005 * rng.standard_normal())
            real[:, 0] += noise * 2e-5 * rng.standard_normal()
            readings = simulate_signals(
                PixelExperiment(real, 0, AMBIENT_K, (t_s, t_s, np.zeros(0))),
                PIXEL,
                ActiveTerms.from_values(terms),
                (delays.temperature, delays.displacement, delays.force),
            )
            signals = {}
            for (signal, white), value in zip(SIGNALS, readings[:2], strict=True):
                keep, coloured = np.exp(-1.0 / rate / 0.01), np.zeros(len(t_s))
                for row in range(1, len(t_s)):
                    kick = 0.4 * white * np.sqrt(1 - keep**2) * rng.standard_normal()
                    coloured[row] = keep * coloured[row - 1] + kick
                noisy = value + noise * (coloured + white * rng.standard_normal(len(t_s)))
                noisy[rng.random(len(t_s)) < 0.01 * (noise > 0)] = np.nan
                signals[signal] = Signal(0, t_s, noisy + (AMBIENT_K if signal.endswith("_K") else 0.0))
            runs.append(Run(f"run{len(runs):03d}", AMBIENT_K, pulses, signals, attributes))
    return Measurement(tuple(runs))


def lab_with_slack(seed):
    """Return the recording of a membrane whose first part of the displacement, SLACK_M, is missing."""
    runs = []
    for noisy, exact in zip(lab(seed, {}).runs, lab(seed, {}, noise=0.0).runs, strict=True):
        signal = noisy.signals["displacement_m"]
        missing_m = np.minimum(exact.signals["displacement_m"].value, SLACK_M)
        runs.append(
            replace(noisy, signals=noisy.signals | {"displacement_m": replace(signal, value=signal.value - missing_m)})
        )
    return Measurement(tuple(runs))
