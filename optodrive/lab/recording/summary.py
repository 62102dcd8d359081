"""Statistics of a recording, one row per run: the output of `optodrive recording show`."""

from typing import Any

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Measurement, Run, Signal


def build_summary(measurement: Measurement) -> list[dict[str, Any]]:
    """Return statistics of each run in SI units as JSON values."""
    return [_summarize_run(run) for run in measurement.runs]


def _summarize_run(run: Run) -> dict[str, Any]:
    group = run.attributes.get("group")
    return {
        "run": run.name,
        "group": None if group is None else str(group),
        "ambient_K": run.ambient_k,
        "attributes": {key: _finite_or_none(value) for key, value in run.attributes.items()},
        "pulses": len(run.pulses),
        "pulsed_pixels": [int(pixel) for pixel in np.unique(run.pulses[:, 3])],
        "energy_J": _finite_or_none(_compute_energy_j(run.pulses)),
        "commands": None if run.commands is None else len(run.commands),
        "signals": {name: _summarize_signal(signal) for name, signal in run.signals.items()},
    }


def _compute_energy_j(pulses: FloatArray) -> float:
    with np.errstate(over="ignore"):
        return float(np.sum(pulses[:, 1] * pulses[:, 2]))


def _summarize_signal(signal: Signal) -> dict[str, Any]:
    measured = signal.value[np.isfinite(signal.value)]
    return {
        "pixel": signal.pixel,
        "samples": len(signal.t_s),
        "missing": len(signal.t_s) - len(measured),
        "start_s": float(signal.t_s[0]),
        "end_s": float(signal.t_s[-1]),
        "min": float(measured.min()),
        "max": float(measured.max()),
        "sigma": signal.sigma,
    }


def _finite_or_none(value: str | float) -> str | float | None:
    # JSON cannot represent NaN and infinity.
    return None if isinstance(value, float) and not np.isfinite(value) else value
