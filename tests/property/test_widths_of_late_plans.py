"""Every pulse has the width for the heat at its start, also of plans, pages and streams that are late.

Fingers under a tracker, pauses, losses on the line and stalls of planner and host are drawn at random, in virtual time.
The judge integrates the board's log by itself.
"""

import re
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest
from test_queue_follows_board import TICK_S, Log

from link_service_rig import WEB, CuttableLink, ServiceRig
from optodrive.core.errors import OptodriveError
from optodrive.core.types.fingers import FingerPlace
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, TactileFrame
from optodrive.daemon.engine import plan_rest
from optodrive.daemon.engine.plan_queue import PlanQueue
from optodrive.link.session.board_group import BoardGroup
from reference_models.thermal_display import window_peak_w
from standing_rig import StandingRig, build_display, build_page

CAPS = ({}, {}, {"pixel_mean_power_max_w": 0.2}, {"display_mean_power_max_w": 0.3})
DISPLAYS = [build_display(**caps) for caps in CAPS]
SHIPPED = DISPLAYS[0]
PIXELS = len(SHIPPED.layout)
HEIGHT_SHARE = 0.02
CAP_SHARE = 1e-3
"""Rounding of powers on the wire, and of the integrator."""
DURATION_S = 1.2
RADIUS_M = 4e-3
KINDS = ("page", "stream", "plan", "train")
EVENTS = {"planner": 5, "host": 5, "line": 2, "planning": 2, "pause": 3, "cancel": 1}


class JobQueue(PlanQueue):
    """Keeps every job with the newest value of its plan."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.jobs = {}

    def _apply(self, state):
        self.jobs |= {id(run.job): run for run in (*self.state.running, *state.running)}
        super()._apply(state)


class Scene:
    """A page, a stream, plans or trains under a moving finger, while planner and host stall."""

    def __init__(self, monkeypatch, seed):
        self.rng = np.random.default_rng(seed)
        self.kind = KINDS[seed % len(KINDS)]
        self.display = DISPLAYS[self.rng.integers(len(DISPLAYS))]
        self.rig = StandingRig(monkeypatch, self.display, queue_type=JobQueue, link_type=CuttableLink).ready()
        self.rig.arm()
        self.rig.run(0.02)
        self.tracker_hz, self.speed_m_per_s = self.rng.uniform(20.0, 120.0), self.rng.uniform(0.02, 0.2)
        pixels = self.rng.choice(PIXELS, int(self.rng.choice([1, 4, 12, 40])), replace=False)
        self.page_m = build_page(SHIPPED, pixels, float(self.rng.choice([30.0, 60.0, 150.0, 300.0])))
        self.events = []

    def run(self):
        rig, begin_s = self.rig, self.rig.clock.now_s()
        seen_s = shown_s = begin_s
        event_s = begin_s + self.rng.uniform(0.1, 0.4)
        while (now_s := rig.clock.now_s()) < begin_s + DURATION_S:
            if now_s >= seen_s:
                self.touch(now_s - begin_s)
                seen_s = now_s + 1.0 / self.tracker_hz
            if now_s >= shown_s:
                shown_s = now_s + self.show()
            if now_s >= event_s:
                self.events.append(str(self.rng.choice(list(EVENTS), p=np.array(list(EVENTS.values())) / 18.0)))
                getattr(self, f"do_{self.events[-1]}")()
                event_s = rig.clock.now_s() + self.rng.uniform(0.05, 0.5)
            rig.run()
        rig.page_m = None
        rig.until(lambda: not rig.queue.is_busy or rig.core.state in ("FAULT", "DISARMED"), 60.0)
        rig.run(0.1)
        return self

    def touch(self, at_s):
        x_m = SHIPPED.layout.x_m
        at_m = x_m.min() + (self.speed_m_per_s * at_s) % np.ptp(x_m)
        self.rig.touch((FingerPlace(1, float(at_m), 0.0, RADIUS_M),))

    def show(self):
        """Show what is next. Return the time until then, s."""
        rig, epoch = self.rig, self.rig.remote.epoch
        if self.kind == "page":
            rig.show(self.page_m)
            return float(self.rng.choice([0.1, 0.3, 2.0]))
        with suppress(OptodriveError):  # as during a pause
            if self.kind == "stream":
                frame = TactileFrame("f", 0.0, 3600.0, self.page_m)
                rig.submit(FrameSequence((frame,)), epoch, streamed=True, lists_pulses=False).result()
            elif not rig.queue.state.waiting:
                rig.submit(self.build_sequence(), epoch).result()
        return float(self.rng.uniform(0.01, 0.1))

    def build_sequence(self):
        if self.kind == "plan":
            return FrameSequence(tuple(TactileFrame(str(k), 0.05 * k, 0.05, self.page_m) for k in range(4)))
        pixel = int(np.argmax(self.page_m))
        target_m, period_s = float(self.page_m[pixel]), float(self.rng.choice([0.03, 0.1]))
        return FrameSequence((), (HeightTrain(pixel, 0.0, 0.3, period_s, target_m),))

    def do_planner(self):
        """Only link and board go on."""
        ServiceRig.run(self.rig, float(self.rng.choice([0.01, 0.03, 0.1, 0.3])))

    def do_host(self):
        self.rig.clock.sleep(float(self.rng.choice([0.01, 0.03, 0.05, 0.07])))

    def do_line(self):
        self.rig.link.is_cut = True
        ServiceRig.run(self.rig, float(self.rng.choice([0.01, 0.03])))
        self.rig.link.is_cut = False

    def do_planning(self):
        self.rig.planning_s = float(self.rng.choice([0.0, 0.002, 0.008, 0.03]))

    def do_pause(self):
        if self.kind in ("plan", "train"):
            for command in ("pause", "resume"):
                self.rig.await_result(WEB, self.rig.request(WEB, command))
                self.rig.run(float(self.rng.choice([0.002, 0.03, 0.2])))

    def do_cancel(self):
        plans = self.rig.queue.state.plans
        if plans:
            self.rig.queue.cancel(plans[0].record)


def list_heights(rig, log):
    """Return the targets of all whole pulses by height, and the heights that they reach by the log, [n, 2], m."""
    heights = []
    for plan, job in rig.queue.jobs.values():
        (part,), rows = job.parts, plan.planned.plan
        reports = part.read_reports(np.arange(part.pulse_count))
        for position, row, on_ticks in zip(part._pulse_points, reports.row, reports.on_ticks, strict=True):
            is_whole = on_ticks > 0 and on_ticks == round(rows.width_s[row] / TICK_S)
            if is_whole and np.isfinite(rows.target_m[row]) and not rows.reason[row] and rows.width_s[row] < 0.0499:
                at = log.of_index[int(part.first_index + position)]
                heights.append((rows.target_m[row], find_height_m(log, at)))
    return np.array(heights).reshape(-1, 2)


def find_height_m(log, row):
    """Return the height to which a pulse raises its pixel."""
    pixel = log.find_pixel(int(log.pixels[row]), log.starts_s[row] + TICK_S)
    return float(pixel.find_height_m(log.ends_s[row] + np.linspace(0.0, 0.1, 2001)).max())


def find_cap_shares(log):
    """Return the largest value over each cap that the scenes may reach."""
    caps, width_s = log.display.budget.caps, log.ends_s - log.starts_s

    def find_peak_w(rows, window_s):
        pulses = {"start_s": log.starts_s[rows], "width_s": width_s[rows], "power_w": log.powers_w[rows]}
        return window_peak_w(Pulses(**pulses), window_s)

    each = [log.pixels == pixel for pixel in np.unique(log.pixels)]
    absorber_k = [
        log.find_pixel(int(pixel), start_s + TICK_S).state[0]
        for pixel, start_s in zip(log.pixels, log.starts_s, strict=True)
    ]
    return {
        "absorber": max(absorber_k) / caps.absorber_k,
        "pixel": max(find_peak_w(rows, caps.pixel_window_s) for rows in each) / caps.pixel_mean_w,
        "display": find_peak_w(slice(None), caps.display_window_s) / caps.display_mean_w,
    }


class Pulses(SimpleNamespace):
    """Columns of the pulses of a log."""

    def __len__(self):
        return len(self.start_s)


def judge(scene):
    """Check the pulses of a scene. Return how many by height were checked."""
    log = Log(scene.rig)
    target_m, height_m = list_heights(scene.rig, log).T
    assert height_m == pytest.approx(target_m, rel=HEIGHT_SHARE)
    assert not len(log.pixels) or max(find_cap_shares(log).values()) <= 1.0 + CAP_SHARE
    return len(target_m)


def play(monkeypatch, seed):
    return judge(Scene(monkeypatch, seed).run())


@pytest.mark.parametrize("seed", [*range(12), 230])
def test_pulses_of_late_plans_reach_their_heights(monkeypatch, seed):
    play(monkeypatch, seed)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_pulses_of_many_late_scenes_reach_their_heights(monkeypatch):
    count = 0
    for seed in range(100, 500):
        with monkeypatch.context() as patches:
            try:
                count += play(patches, seed)
            except BaseException as error:
                error.add_note(f"seed {seed}")
                raise
    assert count > 20_000


def plan_for_older_heat(display, sequence, heat, *arguments):
    """Mutant: a rest is planned for the heat of a tenth of a second before."""
    return PLAN_SEQUENCE(display, sequence, heat.copy_shifted(0.1), *arguments)


PLAN_SEQUENCE = plan_rest.plan_sequence
MUTANTS = {
    "late points leave": (BoardGroup, "describe_lateness", lambda boards: ""),
    "a rest for older heat": (plan_rest, "plan_sequence", plan_for_older_heat),
}


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_mutant_is_caught(monkeypatch, mutant):
    monkeypatch.setattr(*MUTANTS[mutant])
    with pytest.raises(AssertionError):
        play(monkeypatch, 0)


# --- pages that underrun


def stand_with_stalls(monkeypatch, count):
    """Let a page stand, whose host stalls for longer than points are sent ahead. Return the rig and the dark times."""
    rig = StandingRig(monkeypatch, SHIPPED, queue_type=JobQueue).ready()
    rig.arm()
    rig.run(0.02)
    page_m = build_page(SHIPPED, range(40), 60.0)
    rig.stand(page_m, 0.5)
    dark_s = []
    for _ in range(count):
        since_s = rig.clock.now_s()
        rig.clock.sleep(0.07)
        rig.stand(page_m, 1.0)
        dark_s.append(rig.find_longest_dark_s(since_s))
    return rig, dark_s


def test_a_page_that_underruns_goes_on_within_a_second_and_says_so(monkeypatch):
    rig, dark_s = stand_with_stalls(monkeypatch, 2)
    assert max(dark_s) < 0.3
    assert rig.remote.board.underruns == 2  # in telemetry, metrics and `optodrive status`
    assert (rig.core.state, rig.refusals) == ("RUNNING", [])
    errors = [rig.store.find(plan.plan_id).error for plan, _ in rig.queue.jobs.values()]
    assert rig.service.pauses.number == 2
    assert len({error for error in errors if re.fullmatch(r"light would have been [\d.]+ ms late", error or "")}) == 2
    assert [event["reason"] for event in rig.list_events("state")].count("armed") == 1


def test_the_third_underrun_in_ten_seconds_ends_the_light_with_its_name(monkeypatch):
    rig, _ = stand_with_stalls(monkeypatch, 3)
    assert (rig.core.state, rig.remote.board.fault) == ("FAULT", "UNDERRUN")
    assert "the queue ran empty three times within ten seconds" in str(rig.refusals[0])
