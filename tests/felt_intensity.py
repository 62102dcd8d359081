"""The channel model of vibration, stated a second time: what a displacement is felt as."""

import numpy as np

STEP_S = 2e-4


def feel(displacement_m, sensitivity=1.0):
    """Return the intensity of a displacement at STEP_S for a person, by the line spectrum up to 500 Hz."""
    count = len(displacement_m)
    order = np.arange(1, int(500.0 * count * STEP_S) + 1)
    hz = order / (count * STEP_S)
    order, hz = order[hz >= 2.0], hz[hz >= 2.0]
    phase = np.exp(-2j * np.pi * np.outer(order, np.arange(count)) / count)
    amplitude_um = 2e6 / count * np.abs(phase @ displacement_m)
    meissner_um = 3.2 * 10 ** (5 * np.log2(np.maximum(30.0 / hz, 1.0)) / 20)
    pacinian_um = 0.63 * 10 ** (12 * np.abs(np.log2(hz / 250.0)) / 20)
    signals = sorted(
        max(0.0, sensitivity * np.sqrt(np.sum((amplitude_um / um) ** 2)) - 1) for um in (meissner_um, pacinian_um)
    )
    return signals[1] + 0.5 * signals[0]
