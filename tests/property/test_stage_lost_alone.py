"""One stage of several is lost at a random moment and the others draw what is left, judged from the boards' own logs.

The others are dark until the lost board's lease has ended; it gets no other. Nothing is drawn twice; what is missing is
what the lost board was sent for the time before it was dark for certain; no cap is exceeded. Light goes on at once.
"""

import random
from typing import NamedTuple

import numpy as np
import pytest

from optodrive.core.types.plans import PulsePlan
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain, TactileFrame
from optodrive.daemon.engine import plan_rest, queue_state
from optodrive.daemon.engine.plan_rest import EndedPlan, EndedPlans, rewind_estimate
from optodrive.link.protocol.states import BoardState
from optodrive.link.service.link_service import LinkService
from optodrive.link.session.board_group import BoardGroup
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.caps import CapValues
from planner_rig import build_frame
from reference_models.shipped_display import build_model, build_worst_factors
from reference_models.thermal_display import TOUCHED, build_true_display
from stage_loss_rig import KINDS, LossRig

NAME = "display-16"
PIXELS = 16
CLOCK_ERROR_S = 0.001
REACTION_S = 0.004
"""Time from the loss of a board until the others are dark: one exchange."""
RESUMED_S = 0.1
"""Longest time to light from the next frame, or from when the lost board is dark for certain."""
PATIENCE_S = 10.0
MOMENTS = 50


class Case(NamedTuple):
    """One loss. back_after_s: time after which the board answers again; requests: what is drawn meanwhile."""

    kind: str
    seed: int
    count: int
    stage: int
    requests: str
    after_s: float
    back_after_s: float


def draw_case(kind, seed):
    rng = random.Random(f"{kind} {seed}")
    count = rng.choice((2, 3))
    requests = rng.choice(("page", "frames", "trains", "both", "waiting"))
    return Case(kind, seed, count, rng.randrange(count), requests, rng.uniform(-0.02, 0.7), rng.uniform(0.12, 1.2))


def build_requests(case):
    """Return sequences that wait for each other. Frames and trains have pixels of their own."""
    rng = np.random.default_rng(case.seed)
    frames = []
    for k in range(7):
        target_m = np.where(rng.random(PIXELS) < 0.7, rng.uniform(30e-6, 90e-6, PIXELS), 0.0)
        target_m[[0, 3]] = 0.0
        frames.append(TactileFrame(str(k), 0.12 * k, 0.1, target_m))
    trains = [PulseTrain(3 * k, 0.01 * k, 0.9, 0.004, 0.046, 1.5) for k in range(2)]
    trains.append(HeightTrain(8, 0.02, 0.9, 0.08, 40e-6))
    if case.requests == "frames":
        return [FrameSequence(tuple(frames))]
    if case.requests == "trains":
        return [FrameSequence((), tuple(trains))]
    if case.requests == "page":
        return [build_frame(150.0)]
    if case.requests == "both":
        return [FrameSequence(tuple(frames), tuple(trains[:2]))]
    return [FrameSequence(tuple(frames[:3])), FrameSequence((), tuple(trains)), FrameSequence(tuple(frames[3:5]))]


class Planned(NamedTuple):
    """Pulses as they were planned with all stages, all [n]: begin in host time, pixel and stage."""

    start_s: np.ndarray
    pixel: np.ndarray
    stage: np.ndarray

    @classmethod
    def collect(cls, queue):
        """Collect those of all plans that run or wait."""
        plans = [*(run.plan for run in queue.state.running), *queue.state.waiting]
        columns = [
            (active.record.start_s + (plan := active.planned.plan).start_s, plan.pixel, plan.stage) for active in plans
        ]
        return cls(*(np.concatenate(each) for each in zip(*columns, strict=True)))


class Played(NamedTuple):
    """Outcome of a case.

    lost_s: host time at which a board was broken; noticed_s: at which that was noticed; emitted: pulses by the logs
    """

    rig: LossRig
    records: list
    planned: Planned
    lost_s: float
    noticed_s: float
    emitted: PulsePlan


def follow_loss(rig, case, is_over):
    """Break the board, and let it answer again later, until is_over(). Return when it broke and when it was noticed."""
    lost_s, noticed_s, is_back = rig.lose(case.stage, case.kind), np.inf, case.kind in ("kill", "lie")
    while not is_over():
        rig.run(0.002)
        now_s = rig.clock.now_s()
        assert now_s < lost_s + PATIENCE_S, "what is left is not drawn"
        if rig.boards.lost is not None:
            noticed_s = min(noticed_s, now_s)
        if not is_back and now_s > lost_s + case.back_after_s:
            rig.links[case.stage].repair()
            is_back = True
    return lost_s, noticed_s


def play(monkeypatch, case):
    rig = LossRig(monkeypatch, case.count, NAME)
    records = [rig.push(sequence) for sequence in build_requests(case)]
    planned = Planned.collect(rig.queue)
    rig.until(lambda: rig.clock.now_s() >= records[0].start_s + case.after_s)
    lost_s, noticed_s = follow_loss(rig, case, lambda: all(record.has_ended for record in records))
    assert [(record.status, record.error) for record in records] == [("done", None)] * len(records)
    return Played(rig, records, planned, lost_s, noticed_s, rig.collect_emitted())


def check_dark(rig, stage, noticed_s, emitted):
    """Check that one board at a time draws the pixels of the lost one, which gets no other lease."""
    grants = rig.links[stage].grants
    assert max(at_s for at_s, _ in grants) <= noticed_s, "the lost board gets a lease again"
    dark_s, is_lost = max(end_s for _, end_s in grants), emitted.stage == stage
    assert (emitted.start_s[is_lost] <= dark_s + CLOCK_ERROR_S).all(), "the lost board emits after its lease"
    others_s = emitted.start_s[~is_lost]
    is_dark = (others_s < noticed_s + REACTION_S) | (others_s > dark_s)
    assert is_dark.all(), "another beam draws before the lost board is dark"
    for pixel in range(PIXELS):
        mine = emitted.pixel == pixel
        begin_s, end_s = emitted.start_s[mine], (emitted.start_s + emitted.width_s)[mine]
        is_other = np.diff(emitted.stage[mine]) != 0  # one beam may go on where it stands, for the next frame
        assert (begin_s[1:] > end_s[:-1])[is_other].all(), "two beams on one pixel at one time"


def check_drawn(case, played):
    """Check that each planned pulse was emitted once, but for those of which nobody knows."""
    planned, dark_s = played.planned, played.rig.remote.dark_s
    is_unknown = (planned.stage == case.stage) & (planned.start_s > played.lost_s - CLOCK_ERROR_S)
    is_unknown &= planned.start_s < dark_s + CLOCK_ERROR_S
    drawn, requested, unknown = (
        np.bincount(pixel, minlength=PIXELS)
        for pixel in (played.emitted.pixel, planned.pixel, planned.pixel[is_unknown])
    )
    assert (drawn <= requested).all(), "something is drawn twice"
    assert (drawn >= requested - unknown).all(), "something is not drawn"
    assert sum(record.executed_count for record in played.records) <= len(played.emitted)


def compute_fractions(rig, emitted):
    """Return the largest values over the caps by an integrator that shares no code with the limiter."""
    caps: CapValues = rig.display.budget.caps
    peaks = build_true_display(build_model(NAME), build_worst_factors(NAME, -1)).peaks(emitted)
    fractions = {"absorber": peaks[0] / caps.absorber_k, "wall": peaks[2] / caps.wall_k}
    return fractions | {"touched": max(peaks[row] for row in TOUCHED) / caps.touch_k}


def judge(case, played):
    rig, emitted = played.rig, played.emitted
    check_dark(rig, case.stage, played.noticed_s, emitted)
    check_drawn(case, played)
    assert max(compute_fractions(rig, emitted).values()) <= 1.0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "seeds", [range(1), pytest.param(range(1, MOMENTS), marks=pytest.mark.slow)], ids=["some", "all"]
)
def test_the_others_draw_what_is_left(monkeypatch, kind, seeds):
    for seed in seeds:
        case = draw_case(kind, seed)
        judge(case, play(monkeypatch, case))


# --- streams


def play_stream(monkeypatch, case, period_s=0.035, frames=24):
    """Stream frames while a board is lost. Return the outcome and (arrival, begin of the first light) of each."""
    rig, rng = LossRig(monkeypatch, case.count, NAME), np.random.default_rng(case.seed)
    records, pushed = [], []

    def push_if_due():
        if len(records) < frames and (not pushed or rig.clock.now_s() >= pushed[-1] + period_s):
            pushed.append(rig.clock.now_s())
            pixels = rng.choice(PIXELS, rng.integers(3, 12), replace=False)
            records.append(rig.push(build_frame(rng.uniform(30.0, 80.0), pixels), streamed=True))
        return len(records) == frames and all(record.has_ended for record in records)

    begun_s = rig.clock.now_s()
    while rig.clock.now_s() < begun_s + max(0.05, case.after_s):
        push_if_due()
        rig.run(0.002)
    lost_s, noticed_s = follow_loss(rig, case, push_if_due)
    played = Played(rig, records, None, lost_s, noticed_s, rig.collect_emitted())
    return played, np.array(pushed)


def judge_stream(case, played, pushed_s):
    rig, emitted, dark_s = played.rig, played.emitted, played.rig.remote.dark_s
    check_dark(rig, case.stage, played.noticed_s, emitted)
    assert {record.status for record in played.records} <= {"done", "superseded"}
    assert played.records[-1].status == "done"
    resumed_s = emitted.start_s[emitted.start_s > played.noticed_s + REACTION_S].min()
    assert resumed_s <= max(dark_s, pushed_s[pushed_s > played.noticed_s].min(initial=np.inf)) + RESUMED_S
    last = played.records[-1].pulses
    assert set(emitted.pixel[emitted.start_s > pushed_s[-1] + RESUMED_S]) <= set(last.pixel.tolist())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "seeds", [range(1), pytest.param(range(1, MOMENTS), marks=pytest.mark.slow)], ids=["some", "all"]
)
def test_a_stream_goes_on_with_its_newest_frame(monkeypatch, kind, seeds):
    for seed in seeds:
        case = draw_case(kind, seed)
        judge_stream(case, *play_stream(monkeypatch, case))


# --- mutants


def forget_sent(run, lost):
    """Mutant: only what the lost board has reported counts as executed."""
    emitted = np.zeros(len(run.plan.planned.plan), dtype=np.bool_)
    emitted[run.plan.executed_rows] = True
    return emitted


def arm_again(group, readmit=BoardGroup._readmit_lost):
    """Mutant: the lost board is armed and gets a lease when it answers again."""
    readmit(group)
    session = None if group.lost is None else group.sessions[group.lost.stage]
    if session is not None and session.connected:
        if session.board.state == BoardState.DISARMED and not session.has_arming:
            session.arm()
        session.step(0.0, renew_lease=True)


def is_one_draining(group):
    """Mutant: the others do not wait until the lost board is dark."""
    return any(session.is_draining for session in group._present)


MUTANTS = {
    "drawn twice": ("unplug", "frames", 0.2, queue_state, "find_emitted", forget_sent),
    "before the lost board is dark": ("unplug", "page", 0.03, BoardGroup, "is_draining", property(is_one_draining)),
    "a lease again": ("lie", "frames", 0.2, BoardGroup, "_readmit_lost", arm_again),
    "not drawn": ("fault", "frames", 0.2, LinkService, "_interrupt", lambda service, reason: None),
    "was lost": ("fault", "frames", 0.2, DisplayModel, "without_stage", lambda display, lost: display),
}
"""What the judge says, with the loss, the requests, and what is replaced by a mutant."""


@pytest.mark.parametrize("message", MUTANTS)
def test_a_mutant_is_caught(monkeypatch, message):
    kind, requests, after_s, place, name, mutant = MUTANTS[message]
    case = Case(kind, 3, 2, 0, requests, after_s, 0.3)
    judge(case, play(monkeypatch, case))
    monkeypatch.setattr(place, name, mutant)
    with pytest.raises(AssertionError, match=message):
        judge(case, play(monkeypatch, case))


def compute_touched(monkeypatch):
    """Drive one pixel up to the touch cap, lose its board at the begin, and return the share that is reached."""
    rig = LossRig(monkeypatch, 2, NAME, touch_max_c=23.0)
    record = rig.push(FrameSequence((), (PulseTrain(5, 0.0, 1.5, 0.02, 0.004, 2.45),)))
    stage = int(rig.queue.state.waiting[0].planned.plan.stage[0])
    rig.until(lambda: rig.clock.now_s() >= record.start_s)
    rig.lose(stage, "unplug")
    rig.until(lambda: record.has_ended)
    emitted = rig.collect_emitted()
    assert set(emitted.stage.tolist()) == {0, 1}
    return compute_fractions(rig, emitted)["touched"]


def forget_heat(plan, budget, on_progress):
    """Mutant: the bound counts only what the lost board has reported."""
    ended, rows = EndedPlan.from_plan(plan), plan.executed_rows
    kept = PulsePlan(**{name: getattr(ended.plan, name)[rows] for name in PulsePlan.__dataclass_fields__})
    rest = EndedPlans.from_plans([plan])._replace(plans=(ended._replace(plan=kept, dropped=0),))
    return rewind_estimate(rest, np.inf, budget, on_progress)


def test_what_the_lost_board_may_have_emitted_counts_as_heat(monkeypatch):
    assert 0.85 < compute_touched(monkeypatch) <= 1.0
    monkeypatch.setattr(plan_rest, "estimate_before_rest", forget_heat)
    assert compute_touched(monkeypatch) > 1.5
