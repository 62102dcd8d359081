"""A real session and the C core over a faulty link in virtual time, with the tests of the simulated board."""

from functools import partial

import pytest
import test_link_faults_virtual as python_board
from test_link_faults_virtual import *  # noqa: F403
from virtual_rig import VirtualRig

from c_core import SeededCBoard

# Tests of the fault injection or of the host alone, and mutants of the simulated board, replaced below.
del test_a_board_that_violates_a_guard_is_detected  # noqa: F821
del test_equal_seeds_give_equal_faults  # noqa: F821
del test_goodput_of_a_full_line_at_one_percent_loss  # noqa: F821
del test_goodput_of_a_job_at_one_percent_loss  # noqa: F821

FEW_FAULTS, *FAULT_RATES = python_board.FAULT_RATES


SEEDS = range(5, 13)
CHIP_FAULTS = 5_000


@pytest.fixture(autouse=True)
def _c_core_in_every_rig(monkeypatch, library):
    monkeypatch.setattr(python_board, "VirtualRig", partial(VirtualRig, make_core=partial(SeededCBoard, library)))


@pytest.mark.slow
def test_the_emulated_chip_under_link_faults_emits_each_pulse_as_sent_once_and_in_order(chips):
    rig = VirtualRig(6, 0.05, extra=0.6, pauses=0.001, make_core=chips(0))
    pulses = 0
    while rig.faults < CHIP_FAULTS:
        rig.live(3000, patience_s=4.0)
        pulses += rig.check()
    assert pulses > 0
    rig.core.close()


@pytest.mark.parametrize(("seed", "loss"), [pytest.param(*FEW_FAULTS, marks=pytest.mark.slow), *FAULT_RATES])
def test_under_link_faults_each_pulse_is_as_sent_once_and_in_order(seed, loss):
    python_board.test_under_link_faults_each_pulse_is_as_sent_once_and_in_order(seed, loss)


@pytest.mark.parametrize("mutant", [1, 103, 13], ids=["B1", "B12", "B13"])
def test_a_core_without_a_guard_is_detected(libraries, mutant):
    make_core = partial(SeededCBoard, libraries(mutant))

    def run_all():
        for seed in SEEDS:  # which frames are lost when a seed decides, and not each loss meets the guard
            python_board.run_fault_sessions(VirtualRig(seed, 0.15, extra=0.6, pauses=0.001, make_core=make_core))

    with pytest.raises(AssertionError):
        run_all()
