"""A recording of many pixels by the small lab, with runs and optional hidden terms per pixel."""

from dataclasses import replace

from labs import lab
from optodrive.core.types.measurements import Measurement


def display_lab(hidden, seed=0, **design):
    """Record a display.

    hidden: pixel → terms
    design: as lab takes it
    """
    runs = []
    for pixel, terms in hidden.items():
        for run in lab(seed + pixel, terms, **design).runs:
            pulses = run.pulses.copy()
            pulses[:, 3] = pixel
            signals = {name: replace(signal, pixel=pixel) for name, signal in run.signals.items()}
            runs.append(replace(run, name=f"pixel{pixel}-{run.name}", pulses=pulses, signals=signals))
    return Measurement(tuple(runs))
