"""The faster a source streams, the more of its frames are drawn, and each is the newest when it begins.

Virtual time; the judge reads the board's log. Planning takes a given time, in which board, link and the planner's loop
go on.
"""

from math import inf

import numpy as np
import pytest

from displays import DISPLAYS
from link_service_rig import CuttableLink, ServiceRig
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.daemon.engine import plan_queue
from optodrive.daemon.engine import planner as planner_module
from optodrive.daemon.engine.active_plan import RefreshCycle
from optodrive.daemon.engine.plan_making import make_plan
from optodrive.device.config_file import load_config
from optodrive.link.board_setup import build_board_requirements, build_port_settings
from optodrive.link.session.point_stream import PointStream
from optodrive.link.simulator.guards import build_settings
from planner_rig import PlannerRig

NAME = "display-437"
STEP_S = 0.001
HEIGHT_M = 60e-6
RATES_HZ = (5.0, 20.0, 30.0, 60.0, 100.0, 200.0)
ALL_RATES_HZ = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0, 50.0, 60.0, 80.0, 100.0, 120.0, 150.0, 200.0)
IDLE_GAP_S = 2e-3
"""Longer than a move between neighbours: the beam is idle in a longer pause."""
LEADS_S = plan_queue.SHARED_STREAM_LEAD_S + 0.03
"""Longest way of a frame to its light: what has left before it, its planning twice, and the pulse that is running."""


def nightly(*values):
    """Return a case that repeats what its neighbours show."""
    return pytest.param(*values, marks=pytest.mark.slow)


class StreamRig(PlannerRig):
    """A planner that gets frames at a rate, of which the newest waits while it plans.

    arrivals_s: arrival of each planned frame, board time; records: of their plans
    """

    def __init__(self, monkeypatch, planning_s=0.004):
        config = load_config(NAME)
        settings = build_settings(build_port_settings(config).own_settings)
        requirements = build_board_requirements(config)
        options = {"requirements": requirements, "settings": settings, "link_type": CuttableLink}
        super().__init__(monkeypatch, display=DISPLAYS[NAME], **options)
        self.arrivals_s, self.records, self._planning_s = [], [], planning_s
        monkeypatch.setattr(planner_module, "make_plan", self._make_plan)
        self.ready().arm()
        self.run(0.01)

    def _make_plan(self, *arguments):
        plan = make_plan(*arguments)
        end_s = self.clock.now_s() + self._planning_s
        while self.clock.now_s() < end_s - 1e-9:
            super(PlannerRig, self).run(STEP_S, STEP_S)
            self.remote.connection.receive()
            self.queue.update_jobs(self.remote.pop_refusal())
            self.queue.start_next()
        return plan

    def stream(self, pixels, rate_hz, duration_s):
        """Stream frames of some pixels."""
        target_m, begin_s, sent = np.zeros(len(DISPLAYS[NAME].layout)), self.clock.now_s(), 0
        while (now_s := self.clock.now_s()) < begin_s + duration_s:
            newest = int((now_s - begin_s) * rate_hz + 1e-6)
            if newest < sent:
                self.run(STEP_S)
                continue
            sent = newest + 1
            target_m[list(pixels)] = HEIGHT_M
            frame = FrameSequence((TactileFrame(str(newest), 0.0, 3600.0, target_m.copy()),))
            report = self.submit(frame, self.remote.epoch, streamed=True, lists_pulses=False).result()
            self.arrivals_s.append(self.remote.board_s() - (self.clock.now_s() - begin_s - newest / rate_hz))
            self.records.append(self.store.find(report.plan))
        return self

    def finish(self):
        self.until(lambda: not self.queue.is_busy)
        return self

    def list_gate_times_s(self):
        """Return gate on and gate off of each pulse by the board's log, [n, 2]."""
        pulses = [event for event in self.log if event["event"] == "pulse"]
        return np.array([[event["on_us"], event["off_us"]] for event in pulses]).reshape(-1, 2) * 1e-6

    def count_shown(self):
        return sum(record.executed_count > 0 for record in self.records)

    def compute_idle_share(self, since_s, until_s):
        """Return the share of a time in which the beam waits, by the board's log."""
        on_s, off_s = self.list_gate_times_s().T
        gaps_s = np.append(on_s, inf)[1:] - off_s
        is_within = (off_s > since_s) & (off_s + gaps_s < until_s)
        return float(gaps_s[is_within & (gaps_s > IDLE_GAP_S)].sum()) / (until_s - since_s)

    def list_ages_s(self):
        """Return the time from each shown frame's arrival to its first light."""
        return [record.first_light_after_s for record in self.records if record.first_light_after_s is not None]


def choose_pixels(count):
    return range(437 - count, 437) if count > 40 else range(200, 200 + count)


def measure(monkeypatch, count, rate_hz, duration_s):
    with monkeypatch.context() as patches:
        rig = StreamRig(patches)
        begin_s = rig.remote.board_s()
        rig.stream(choose_pixels(count), rate_hz, duration_s)
        idle = rig.compute_idle_share(begin_s + 0.1, begin_s + duration_s)
        rig.finish()
    assert rig.session.board.underruns == 0
    assert rig.remote.board.state == "ARMED"
    return rig, rig.count_shown() / duration_s, idle


def find_falls(monkeypatch, count, rates_hz, duration_s):
    """Return where fewer frames are shown at a higher rate, and the frames shown per second at each rate."""
    shown = [measure(monkeypatch, count, rate_hz, duration_s)[1] for rate_hz in rates_hz]
    return [rates_hz[k + 1] for k in range(len(shown) - 1) if shown[k + 1] < shown[k]], shown


@pytest.mark.parametrize("count", [1, 4])
def test_frames_shown_do_not_fall_as_the_rate_rises(monkeypatch, count):
    falls, shown = find_falls(monkeypatch, count, RATES_HZ, 0.6)
    assert not falls, shown


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 4, 40, 400])
def test_frames_shown_do_not_fall_at_any_of_many_rates(monkeypatch, count):
    falls, shown = find_falls(monkeypatch, count, ALL_RATES_HZ, 2.0)
    assert not falls, shown


@pytest.mark.parametrize(
    ("count", "rate_hz"),
    [(1, 200.0), (4, 60.0), nightly(4, 200.0), (8, 100.0), (8, 200.0), (40, 60.0), nightly(40, 200.0), (400, 60.0)],
)
def test_the_newest_frame_begins_and_the_beam_does_not_wait_while_newer_ones_do(monkeypatch, count, rate_hz):
    rig, _, idle = measure(monkeypatch, count, rate_hz, 0.6)
    assert max(rig.list_ages_s()) < LEADS_S
    assert idle < 0.1 or count < 8  # few pixels are drawn before the next frame


def test_frames_that_supersede_each_other_before_their_first_byte_are_caught(monkeypatch):
    """Mutant: nothing follows a plan whose points have all left, so each new frame replaces the one that waits."""
    monkeypatch.setattr(plan_queue, "APPEND_LEAD_S", inf)
    falls, shown = find_falls(monkeypatch, 4, RATES_HZ, 0.6)
    assert falls, shown
    assert measure(monkeypatch, 8, 200.0, 0.6)[2] > 0.2


def test_an_older_frame_that_begins_is_caught(monkeypatch):
    """Mutant: a frame goes behind the whole of the one before it."""
    build = plan_queue.build_cut_snapshot

    def build_behind(running, thermal, min_start_s, *arguments, **named):
        return build(running, thermal, inf, *arguments, **named)

    monkeypatch.setattr(plan_queue, "build_cut_snapshot", build_behind)
    rig, _, _ = measure(monkeypatch, 40, 60.0, 0.6)
    assert max(rig.list_ages_s()) > 2 * LEADS_S


# --- the host stalls


def stall(rig, stall_s):
    """Let the computer stand still while the board goes on, six times in a stream."""
    rig.stream(choose_pixels(4), 100.0, 0.2)
    for _ in range(6):
        rig.clock.sleep(stall_s)
        rig.stream(choose_pixels(4), 100.0, 0.1)


@pytest.mark.parametrize("stall_s", [0.005, nightly(0.012), 0.02, nightly(0.03), 0.06])
def test_a_stream_goes_on_after_the_host_has_stalled(monkeypatch, stall_s):
    rig = StreamRig(monkeypatch)
    stall(rig, stall_s)
    rig.finish()
    assert {record.status for record in rig.records} <= {"done", "superseded"}
    assert sum(record.executed_count for record in rig.records) == len(rig.list_gate_times_s())
    assert rig.session.board.underruns == 0


def test_a_frame_whose_end_came_after_the_board_had_ended_the_job_is_drawn(monkeypatch):
    """The line loses the points that move the END, until the board has ended. Mutant: the link does not notice."""
    for find_sent_tick, is_drawn in ((PointStream.find_sent_tick, True), (lambda *arguments: None, False)):
        with monkeypatch.context() as patches:
            patches.setattr(PointStream, "find_sent_tick", find_sent_tick)
            rig = StreamRig(patches)
            rig.stream(choose_pixels(4), 100.0, 0.1)
            rig.stream(choose_pixels(4), 1000.0, STEP_S)  # handed over, and not yet sent
            assert rig.queue.state.running[-1].plan.plan_id == rig.records[-1].plan_id
            rig.link.is_cut = True
            ServiceRig.run(rig, 0.06, STEP_S)
            rig.link.is_cut = False
            for _ in range(200):
                rig.run()
            assert (rig.records[-1].status == "done") == is_drawn
            assert rig.session.board.underruns == 0


# --- frames that come again


def find_worst_interval(rig, count, rate_hz):
    """Return the largest deviation of an interval between two pulses of a pixel, in periods, by the board's log."""
    rig.stream(choose_pixels(count), rate_hz, 12 / rate_hz).finish()
    return find_deviations(rig, count, rate_hz, 3).max()


def find_deviations(rig, count, rate_hz, settled):
    """Return the deviations of the intervals between two pulses of a pixel, in periods, by the board's log.

    settled: number of the first intervals, in which the time reserved for planning and the rhythm settle
    """
    pulses = [event for event in rig.log if event["event"] == "pulse"]
    places = np.array([(event["x"], event["y"]) for event in pulses])
    on_s = rig.list_gate_times_s()[:, 0]
    names = np.unique(places, axis=0, return_inverse=True)[1].ravel()
    return np.abs(np.concatenate([np.diff(on_s[names == name])[settled:] for name in range(count)]) * rate_hz - 1.0)


@pytest.mark.parametrize(("count", "rate_hz"), [(4, 20.0), (4, 50.0), nightly(1, 30.0), nightly(12, 10.0), (20, 5.0)])
def test_a_frame_that_is_streamed_again_keeps_the_period_of_each_pixel(monkeypatch, count, rate_hz):
    # The rig notices an arrival within a step.
    assert find_worst_interval(StreamRig(monkeypatch), count, rate_hz) < 0.05 + STEP_S * rate_hz


SOURCE_JITTER_S, PLANNING_S = 0.003, (0.002, 0.003, 0.004, 0.005)


def stream_unevenly(monkeypatch, count, rate_hz):
    """Stream 30 equal frames, unevenly. Return the worst deviation of a pixel's interval, in periods, and the rig."""
    rng, rig = np.random.default_rng(0), StreamRig(monkeypatch)
    make_plan_at_once = rig._make_plan

    def plan_unevenly(*arguments):
        rig._planning_s = float(rng.choice(PLANNING_S))
        return make_plan_at_once(*arguments)

    monkeypatch.setattr(planner_module, "make_plan", plan_unevenly)
    begin_s, late_s = rig.clock.now_s() + 0.02, rng.uniform(0.0, SOURCE_JITTER_S, 30)
    for number in range(30):
        rig.until(lambda: rig.clock.now_s() >= begin_s + number / rate_hz + late_s[number])  # noqa: B023 - at once
        rig.stream(choose_pixels(count), 1e9, 1e-9)
    rig.finish()
    return find_deviations(rig, count, rate_hz, 8).max(), rig


@pytest.mark.parametrize(("count", "rate_hz"), [(4, 20.0), (1, 30.0), (6, 30.0), (4, 40.0), (4, 60.0)])
def test_a_frame_that_comes_again_keeps_its_period_though_source_and_planning_do_not(monkeypatch, count, rate_hz):
    deviation, rig = stream_unevenly(monkeypatch, count, rate_hz)
    assert deviation < 0.05
    assert max(rig.list_ages_s()) < LEADS_S


def test_frames_that_begin_as_they_arrive_are_caught(monkeypatch):
    """Mutant: a frame does not wait for its beat."""
    monkeypatch.setattr(RefreshCycle, "find_beat_s", lambda cycle, first, interval_s, ready_s: ready_s)
    assert stream_unevenly(monkeypatch, 4, 60.0)[0] > 0.15


def test_a_path_that_reverses_from_frame_to_frame_is_caught(monkeypatch):
    """Mutant: each frame follows the shortest path."""
    monkeypatch.setattr(RefreshCycle, "find_order", lambda self, target_m: None)
    assert find_worst_interval(StreamRig(monkeypatch), 4, 50.0) > 0.3
