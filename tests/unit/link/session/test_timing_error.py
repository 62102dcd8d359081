import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from test_session import Rig, plan

from optodrive.link.session.clock_sync import TimingTotals, compute_timing_error
from optodrive.link.simulator.guards import BoardSettings

PLANNED_S = np.arange(1, 101) * 0.01


@given(st.floats(-0.1, 0.1), st.floats(-500, 500))
def test_delay_and_drift_are_separated(delay_s, drift_ppm):
    executed_s = PLANNED_S + delay_s + drift_ppm * 1e-6 * (PLANNED_S - PLANNED_S[0])
    error = compute_timing_error(PLANNED_S, executed_s)
    assert error.pulses == 100
    assert error.start_delay_s == pytest.approx(delay_s, abs=1e-12)
    assert error.drift_ppm == pytest.approx(drift_ppm, abs=1e-5)
    assert error.median_s == pytest.approx(delay_s + drift_ppm * 1e-6 * 0.495, abs=1e-12)


@given(arrays(float, 100, elements=st.floats(-1e-3, 1e-3)))
def test_max_abs_is_the_signed_error_of_largest_magnitude(off_s):
    error = compute_timing_error(PLANNED_S, PLANNED_S + off_s)
    assert abs(error.max_abs_s) == pytest.approx(np.abs(off_s).max(), abs=1e-12)
    assert np.abs(off_s - error.max_abs_s).min() < 1e-12


def test_totals_keep_the_errors_of_largest_magnitude():
    totals = TimingTotals()
    assert totals.worst is None
    for off_s in (1e-5, -3e-5, 2e-5):
        totals.add(compute_timing_error(PLANNED_S, PLANNED_S + off_s))
    worst = totals.worst
    assert worst.pulses == 300
    assert (worst.max_abs_s, worst.median_s) == pytest.approx((-3e-5, -3e-5))
    assert worst.drift_ppm == pytest.approx(0.0, abs=1e-6)


def test_on_the_simulated_board_only_an_underrun_delays_pulses():
    rig = Rig(BoardSettings(queue_points=64)).connect().arm()
    limited = plan(200)
    scale = rig.session.scale

    def error_of(job):
        executed = job.build_executed(limited, scale)
        return compute_timing_error(limited.start_s[job.list_executed_rows()], executed.start_s)

    job = rig.play(limited)
    rig.until(lambda: job.is_finished)
    assert error_of(job).max_abs_s == pytest.approx(0.0, abs=1e-6)
    job = rig.play(limited)
    rig.run(0.15)
    rig.link.drop_frame = lambda frame: frame.type == 0x10
    rig.until(lambda: rig.session.board.state == "HOLD" or job.is_finished)
    rig.run(0.02)
    rig.link.drop_frame = lambda frame: False
    rig.until(lambda: job.is_finished)
    assert rig.session.board.underruns == 1
    error = error_of(job)
    assert error.start_delay_s == pytest.approx(0.0, abs=1e-6)
    assert 0.01 < error.max_abs_s < 0.5
    assert error.drift_ppm > 100
