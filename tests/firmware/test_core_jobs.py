"""The simulated board's tests of arming, jobs, holds, reports and faults, run on the C core."""

from functools import partial

import pytest
import test_board_core as python_board
from c_board import CBench
from test_board_core import *  # noqa: F403

# Tests of the simulated board's internals. Inputs at power-up and 32 bits of time have other tests here.
del test_the_timing_of_the_contract  # noqa: F821
del test_no_arming_with_an_input_that_is_not_safe  # noqa: F821
del test_a_report_never_runs_over_more_than_32_bits_of_time  # noqa: F821
del test_mean_account_is_the_fullest_second_of_all  # noqa: F821
del test_energy_is_rounded_up_and_full_duty_is_full_power  # noqa: F821


@pytest.fixture(autouse=True)
def _c_core_on_every_bench(monkeypatch, library):
    monkeypatch.setattr(python_board, "Bench", partial(CBench, library))


@pytest.fixture
def bench(library):
    return CBench(library).ready()
