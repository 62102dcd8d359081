"""A small recording for tests, and the comparison of two recordings."""

import numpy as np

from optodrive.core.types.measurements import Measurement, Run, Signal

T_S = np.linspace(0.0, 0.1, 101)


def recording():
    rng = np.random.default_rng(1)
    height_m = rng.standard_normal(101) * 1e-4
    height_m[[3, 40]] = np.nan
    signals = {
        "absorber_temperature_K": Signal(17, T_S, 293.15 + T_S / 3),
        "displacement_m": Signal(17, T_S, height_m, 1e-7 / 3),
    }
    pulses = np.array([[0.0, 0.02, 2.45, 17.0], [0.05, 0.02, 1.0 / 3.0, 18.0]])
    attributes = {
        "bridge_width_m": 4e-4,
        "sample": 'Nr. "5"\nµm\x7f\\',
        "group": "a",
        "started_at": "2024-05-01T12:00:00+02:00",
        "count": 7,
        "odd key": float("inf"),
    }
    steps = np.column_stack([T_S[::10], 0.1 * T_S[::10], -0.1 * T_S[::10]])
    mirrors = {"mirror_x_rad": Signal(0, T_S - 0.01, 0.1 * T_S), "mirror_y_rad": Signal(0, T_S, -0.1 * T_S, 1e-6)}
    return Measurement(
        (
            Run("run2", 293.15, pulses, signals, attributes),
            Run("run10", 150.0, np.zeros((0, 4)), mirrors, {}, steps),
        )
    )


def assert_same(first, second):
    assert [run.name for run in first.runs] == [run.name for run in second.runs]
    for one, other in zip(first.runs, second.runs, strict=True):
        assert (one.ambient_k, one.attributes) == (other.ambient_k, other.attributes)
        assert [type(value) for value in one.attributes.values()] == [
            type(value) for value in other.attributes.values()
        ]
        assert np.array_equal(one.pulses, other.pulses)
        assert (one.commands is None) == (other.commands is None)
        assert one.commands is None or np.array_equal(one.commands, other.commands)
        assert list(one.signals) == list(other.signals)
        for name, signal in one.signals.items():
            twin = other.signals[name]
            assert (signal.pixel, signal.sigma) == (twin.pixel, twin.sigma)
            assert np.array_equal(signal.t_s, twin.t_s)
            assert np.array_equal(signal.value, twin.value, equal_nan=True)


def sorted_attributes(measurement):
    """Return the recording with attributes sorted by name, as HDF5 lists them."""
    runs = [
        Run(r.name, r.ambient_k, r.pulses, r.signals, dict(sorted(r.attributes.items())), r.commands)
        for r in measurement.runs
    ]
    return Measurement(tuple(runs))
