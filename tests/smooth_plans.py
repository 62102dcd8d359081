"""Random plans for the judge of smooth moves, on the display with 1,511 pixels."""

import numpy as np

from displays import DISPLAYS

CONFIG = DISPLAYS["display-1511"].config
PITCH_RAD = CONFIG.display.pitch_m / (2.0 * CONFIG.scanner.focal_length_m)
CODE_RAD = CONFIG.scanner.rad_per_code
TOLERANCE_RAD = min(CONFIG.tolerance_rad) - CODE_RAD
PITCHES_MAX = 2


def sample_plan(random, table, count, min_dwell_s):
    """Return the light of a plan, on_s, off_s [n] and places_rad [n, 2]. Most pulses follow as soon as they may."""
    steps = random.integers(-PITCHES_MAX, PITCHES_MAX + 1, (count, 2))
    steps[random.random(count) < 0.5, random.integers(2)] = 0
    steps[(steps == 0).all(axis=1)] = (1, 0)
    places_rad = np.cumsum(steps, axis=0) * table.pitch_rad
    places_rad = np.round(places_rad / CODE_RAD) * CODE_RAD
    longer = random.random((2, count)) < 0.3
    dwell_s = min_dwell_s + np.where(longer[0], np.round(random.uniform(0.0, 3e-3, count), 6), 0.0)
    dark_s = (
        table.dark_s(np.diff(places_rad, axis=0))
        + np.where(longer[1], np.round(random.uniform(0.0, 1e-3, count), 6), 0.0)[1:]
    )
    on_s = 0.01 + np.concatenate([[0.0], np.cumsum(dwell_s[:-1] + dark_s)])
    return on_s, on_s + dwell_s, places_rad
