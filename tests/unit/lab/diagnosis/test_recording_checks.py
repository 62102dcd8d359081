"""A copy is no repeat: refused where it contains noise, and accepted where a simulation has none."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labs import lab
from optodrive.core.errors import InputError
from optodrive.core.types.measurements import Measurement
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.diagnosis.recording_checks import check_copied_runs


def copy_first(measurement):
    return Measurement((*measurement.runs, replace(measurement.runs[0], name="again")))


def test_a_copy_with_noise_is_refused_by_name():
    measurement = lab(3, {})
    name = measurement.runs[0].name
    with pytest.raises(InputError, match=f"recording: again: got a copy of {name}, expected a repeat"):
        diagnose(copy_first(measurement))


@pytest.mark.parametrize("stride", [1, 5, 20])
def test_repeats_of_a_simulation_without_noise_are_none(stride):
    """Sampled coarsely, a smooth signal differs from sample to sample as well, but more over two samples."""
    runs = []
    for run in copy_first(lab(3, {}, noise=0.0)).runs:
        signals = {
            name: replace(item, t_s=item.t_s[::stride], value=item.value[::stride])
            for name, item in run.signals.items()
        }
        runs.append(replace(run, signals=signals))
    check_copied_runs(Measurement(tuple(runs)))


@given(st.integers(0, 10_000))
def test_repeats_with_their_own_noise_are_none(seed):
    measurement, generator = lab(3, {}, noise=0.0), np.random.default_rng(seed)
    runs = []
    for name in "123":
        noisy = {
            key: replace(item, value=item.value + generator.normal(0.0, 1e-3 * np.ptp(item.value), len(item.value)))
            for key, item in measurement.runs[0].signals.items()
        }
        runs.append(replace(measurement.runs[0], name=name, signals=noisy))
    check_copied_runs(Measurement(tuple(runs)))
    with pytest.raises(InputError, match="got a copy of 1"):
        check_copied_runs(Measurement((*runs, replace(runs[0], name="copy"))))
