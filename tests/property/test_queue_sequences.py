"""Random sequences of everything that changes the queue of plans, against a plain model and the boards' own logs.

No pixel belongs to two pushes, so that each pulse of a log says of which push it is. The model knows of a push how
often it may light a pixel, and when its light must have ended: at the end of its epoch, when it is withdrawn, in a
pause. The heat of each pixel follows from the logs alone, and the queue counts it once. All parts are real; time is
virtual.
"""

from contextlib import suppress
from dataclasses import replace
from math import inf
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import Phase, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule, run_state_machine_as_test
from test_queue_follows_board import HEIGHT_ERROR_MAX_M, Log, Pixel, RecordingQueue, check_heat

from displays import DISPLAYS
from link_service_rig import OPERATOR, WEB, CuttableLink
from optodrive.core.errors import OptodriveError
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.engine.queue_state import QueueState
from optodrive.link.board_setup import build_board_requirements, build_port_settings
from optodrive.link.simulator.guards import build_settings
from planner_rig import PlannerRig
from stage_loss_rig import LossRig

NAME = "display-437"
DARK_S = 0.004
"""Time from an answer to the end of the light: one exchange with the board."""
RESENT_S = 0.05
"""Time within which a link that has lost frames has sent them again, before what follows them."""
PIXELS_PER_CUT = 2
"""Pulses within the way to the board, of which nobody knows whether they came before the light was turned off."""
PIXELS_PER_LATE_CUT = 4
"""The same of a link that passes nothing for 30 ms. The bound counts them: up to the end of the lease."""
SECONDS = st.sampled_from([0.002, 0.01, 0.03, 0.1, 0.3])
COUNTS = st.sampled_from([1, 4, 20])
HEIGHTS_UM = st.sampled_from([30.0, 80.0, 150.0])


class Pushed(NamedTuple):
    """A push: its record, its pixels, how often it may light each, and the number of its epoch."""

    record: object
    pixels: tuple
    times: int
    epoch: int


class QueueMachine(RuleBasedStateMachine):
    """A planner that gets pushes and commands in any order.

    ends_s: board times at which epochs have ended; pauses_s: begins and ends of answered pauses
    withdrawn_s: board time at which a push was cancelled, by plan; cuts: how often light was turned off
    """

    dark_s, is_exact, height_error_m = DARK_S, True, HEIGHT_ERROR_MAX_M

    def __init__(self):
        super().__init__()
        self.patch = pytest.MonkeyPatch()
        self.pushed, self.free, self.ends_s, self.pauses_s, self.withdrawn_s = [], 0, [], [], {}
        self.cuts, self.may_be_late = 0, False
        self.rig = self.build_rig()

    def build_rig(self):
        config = DISPLAYS[NAME].config
        settings_ = build_settings(build_port_settings(config).own_settings)
        options = {"requirements": build_board_requirements(config), "settings": settings_, "link_type": CuttableLink}
        rig = PlannerRig(self.patch, RecordingQueue, DISPLAYS[NAME], **options).ready()
        rig.arm()
        rig.run(0.01)
        return rig

    def now_s(self):
        return self.rig.remote.board_s()

    # --- what may happen

    def push(self, build, count, times, **options):
        pixels = tuple(range(self.free, self.free + count))
        if pixels[-1] >= len(DISPLAYS[NAME].layout):
            return
        self.free += count
        with suppress(OptodriveError):  # as during a pause, or disarmed
            report = self.rig.submit(build(pixels), self.rig.remote.epoch, **options).result()
            self.pushed.append(Pushed(self.rig.store.find(report.plan), pixels, times, len(self.ends_s)))

    @rule(cycles=st.sampled_from([3, 15]))
    def accept_train(self, cycles):
        self.push(lambda at: FrameSequence((), (PulseTrain(at[0], 0.0, 0.02 * cycles, 0.008, 0.012, 1.0),)), 1, cycles)

    @rule(count=COUNTS, height_um=HEIGHTS_UM)
    def accept_frame(self, count, height_um):
        self.push(lambda at: build_frame(at, height_um), count, 1)

    @rule(count=COUNTS, height_um=HEIGHTS_UM, refreshes=st.booleans())
    def stream(self, count, height_um, refreshes):
        """A frame that replaces what is unsent, and is extended later if it is long."""
        options = {"streamed": True, "lists_pulses": False, "refreshes": refreshes}
        # What is no stream ends for it, with the gate off.
        self.cuts += any(not run.plan.record.streamed for run in self.rig.queue.state.running)
        self.push(lambda at: build_frame(at, height_um), count, 1, **options)

    @rule(number=st.integers(0, 5))
    def withdraw(self, number):
        plans = self.rig.queue.state.plans
        if plans:
            record = plans[number % len(plans)].record
            self.cuts += record.status == "running"
            self.rig.queue.cancel(record)
            self.rig.run()  # the link process sends it
            self.withdrawn_s[record.plan_id] = self.now_s()

    @rule()
    def pause(self):
        result = self.rig.await_result(WEB, self.rig.request(WEB, "pause"))
        self.note_light()
        if result["error"] is None:
            self.pauses_s.append([self.now_s(), inf])

    def note_light(self):
        if self.pauses_s:
            self.pauses_s[-1][1] = min(self.pauses_s[-1][1], self.now_s())

    @rule()
    def resume(self):
        self.note_light()
        self.rig.await_result(WEB, self.rig.request(WEB, "resume"))

    @rule(share=st.sampled_from([0.3, 0.7, 1.0]))
    def dim(self, share):
        self.rig.dimmer.set_share(share)

    def end_epoch(self, end):
        self.cuts += bool(self.rig.queue.state.running)
        end()
        self.ends_s.append(self.now_s())
        self.rig.run(0.02)
        self.rig.await_result(WEB, self.rig.request(WEB, "disarm"))
        self.note_light()
        self.arm()

    def arm(self):
        self.rig.arm()
        self.rig.run(0.01)

    def set_interlock(self, is_closed):
        self.rig.core.set_input("interlock", is_closed, round(self.rig.clock.now_s() * 1e6))

    def cut_link(self, is_cut):
        self.rig.link.is_cut = is_cut

    @rule()
    def stop(self):
        self.end_epoch(lambda: self.rig.await_result(OPERATOR, self.rig.request(OPERATOR, "stop")))

    @rule(kind=st.sampled_from(["web", "interlock"]))
    def lose(self, kind):
        def end():
            if kind == "web":
                self.rig.leave(WEB)
                self.rig.run(0.01)
                self.rig.hello(WEB, "web")
            else:
                self.set_interlock(False)
                self.rig.run(0.01)
                self.set_interlock(True)

        self.end_epoch(end)

    @rule(stall_s=st.sampled_from([0.01, 0.03]), is_host=st.booleans())
    def report_late(self, stall_s, is_host):
        """The host stalls, or the link passes nothing for a while."""
        self.may_be_late = True
        if is_host:
            self.rig.clock.sleep(stall_s)
        else:
            self.cut_link(True)
            self.rig.run(stall_s)
            self.cut_link(False)

    @rule(seconds=SECONDS)
    def wait(self, seconds):
        self.rig.run(0.0)
        until_s = self.rig.clock.now_s() + seconds
        while self.rig.clock.now_s() < until_s:
            self.rig.run()

    def teardown(self):
        try:
            self.resume()
            self.rig.until(lambda: not self.rig.queue.is_busy, 60.0)
            states = [entry["state"] for log in self.list_logs() for entry in log if entry["event"] == "state"]
            self.cuts += states.count("FAULT")
            self.judge_heat(self.list_light())  # at once: it decays
            self.wait(0.1)
            self.judge()
        finally:
            self.patch.undo()

    # --- the plain model

    def list_logs(self):
        return [self.rig.log]

    def list_light(self):
        """Return (gate on, gate off, pixel, power) of all pulses by the logs, s and W, in order of time."""
        log = Log(self.rig)
        return list(zip(log.starts_s, log.ends_s, log.pixels.tolist(), log.powers_w, strict=True))

    def judge(self):
        light, counts = self.list_light(), {}
        owner = {pixel: push for push in self.pushed for pixel in push.pixels}
        for on_s, _, pixel, _ in light:
            counts[pixel] = counts.get(pixel, 0) + 1
            push = owner[pixel]
            assert on_s <= [*self.ends_s, inf][push.epoch] + self.dark_s, "light after its epoch"
            dark_s = self.withdrawn_s.get(push.record.plan_id, inf) + self.dark_s + RESENT_S * self.may_be_late
            assert on_s <= dark_s, "light of a withdrawn push"
            for begun_s, ended_s in self.pauses_s:
                assert not begun_s + self.dark_s < on_s < ended_s, "light in a pause"
        for push in self.pushed:
            assert all(counts.get(pixel, 0) <= push.times for pixel in push.pixels), "a pulse twice"
        self.judge_records(counts)
        self.judge_heat_before_plans()

    def judge_records(self, counts):
        records = self.rig.store.list_recent()
        assert all(record.has_ended for record in records)
        assert all(record.executed_count + record.dropped <= record.pulse_count for record in records)
        executed = sum(record.executed_count for record in records)
        assert len(records) == 20 or self.rig.queue.accounts.totals["executed"] == executed
        if self.is_exact and not (self.cuts or self.ends_s) and len(records) < 20:
            assert executed == sum(counts.values()), "light that was counted twice, or not at all"
        for push in self.pushed:
            if self.is_exact and push.record.status == "done":
                assert all(counts.get(pixel, 0) == push.times for pixel in push.pixels), "light that is missing"

    def judge_heat_before_plans(self):
        """Compare the heat from which each plan was made with that of the log when the plan begins."""
        log = Log(self.rig)
        for plan, _ in self.rig.queue.ended:
            is_comparable = plan.executed_before and not plan.first_row and not (self.may_be_late and self.cuts)
            if is_comparable:
                is_known = not (self.cuts or self.ends_s or self.may_be_late)
                check_heat(plan, log, HEIGHT_ERROR_MAX_M if is_known else inf)

    def judge_heat(self, light):
        """Compare the heat that the queue counts with that of the logs: never less, more only where light was cut."""
        state, pixels = self.rig.queue.state, self.rig.display.pixels
        at_s = max(self.now_s(), state.end_s)  # that of a plan which was withdrawn, if its heat still counted
        counted_m = state.thermal.heat.state_at(at_s).displacement_m
        emitted, beyond, missing = {}, 0, 0
        for on_s, off_s, pixel, power_w in light:
            one = emitted.setdefault(pixel, Pixel(pixels, pixel))
            one.advance(on_s)
            one.advance(off_s, power_w)
        for pixel in range(self.free):
            height_m = emitted[pixel].find_height_m(at_s) if pixel in emitted else 0.0
            missing += counted_m[pixel] < height_m - self.height_error_m
            beyond += counted_m[pixel] > height_m + self.height_error_m
        assert missing <= self.may_be_late * PIXELS_PER_LATE_CUT * self.cuts, "heat that is not counted"
        assert beyond <= PIXELS_PER_CUT * self.cuts or not self.is_exact, "heat that is counted without light"


def build_frame(pixels, height_um):
    target_m = np.zeros(len(DISPLAYS[NAME].layout))
    target_m[list(pixels)] = 1e-6 * height_um
    return FrameSequence((TactileFrame("f", 0.0, 3600.0, target_m),))


class StageMachine(QueueMachine):
    """Two boards, one of which may be lost while the other goes on. Nobody knows when within a pulse it went dark."""

    dark_s, is_exact, height_error_m = 0.006, False, 5e-6  # two clocks differ by up to 0.1 ms

    def build_rig(self):
        self.lost = None
        return LossRig(self.patch, 2, NAME)

    @rule(stage=st.integers(0, 1), kind=st.sampled_from(["fault", "unplug"]))
    def lose_stage(self, stage, kind):
        if self.lost is None and self.rig.remote.lost is None and not self.rig.queue.is_held:
            self.lost = stage
            self.rig.lose(stage, kind)
            self.wait(0.3)

    def arm(self):
        if self.lost is None:
            super().arm()
        else:
            self.rig.restore(self.lost)
            self.lost = None

    def set_interlock(self, is_closed):
        self.rig.cores[0].set_input("interlock", is_closed, self.rig.links[0]._now_us())

    def cut_link(self, is_cut):
        self.rig.links[0].kind = "cut" if is_cut else ""

    def list_logs(self):
        return self.rig.logs

    def list_light(self):
        emitted = self.rig.collect_emitted()
        columns = emitted.start_s, emitted.start_s + emitted.width_s, emitted.pixel, emitted.power_w
        return list(zip(*(column.tolist() for column in columns), strict=True))

    def judge_heat_before_plans(self):
        """Leave that to the heat after all plans: their times are those of two clocks."""


EXAMPLES = settings.default.max_examples
GATE = settings(
    max_examples=settings.default.max_examples, stateful_step_count=20, phases=(Phase.generate,), derandomize=True
)
"""Of every run the same sequences; the slow test draws others."""


def test_no_pulse_is_lit_twice_or_late_and_heat_is_counted_once():
    run_state_machine_as_test(QueueMachine, settings=settings(GATE, max_examples=EXAMPLES // 2))


def test_nor_when_a_stage_is_lost():
    run_state_machine_as_test(StageMachine, settings=settings(GATE, max_examples=EXAMPLES // 8))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("piece", range(100))
def test_the_same_in_a_hundred_thousand_sequences(piece):
    machine = StageMachine if piece % 10 == 9 else QueueMachine
    many = settings(GATE, max_examples=1000, derandomize=False)
    run_state_machine_as_test(seed(piece)(type("Piece", (machine,), {})), settings=many)


# --- mutants


def pause_a_frame(machine):
    machine.accept_frame(20, 150.0)
    machine.wait(0.1)
    machine.pause()
    machine.resume()


def withdraw_the_second(machine):
    for _ in range(2):
        machine.accept_frame(20, 150.0)
    machine.wait(0.1)
    machine.withdraw(1)


def withdraw_the_first(machine):
    machine.accept_frame(20, 150.0)
    machine.wait(0.1)
    machine.withdraw(0)


def stream_four(machine):
    for _ in range(4):
        machine.stream(20, 80.0, refreshes=False)
        machine.wait(0.03)


def accept_two(machine):
    machine.accept_frame(4, 150.0)
    machine.accept_frame(20, 150.0)


def interrupt_a_row_earlier(plan, off_s):
    """Mutant: the last executed row is left once more."""
    plan = KEPT_INTERRUPT(plan, off_s)
    return replace(plan, first_row=plan.first_row - 1)


KEPT_INTERRUPT, KEPT_ACCEPT = ActivePlan.interrupt, QueueState.accept
MUTANTS = {
    "a pulse twice": (ActivePlan, "interrupt", interrupt_a_row_earlier, pause_a_frame),
    "without light": (QueueState, "_go_back", lambda state, plan: state, withdraw_the_second),
    "heat that is counted": (QueueState, "_rewind", lambda state, *_: state, withdraw_the_first),
    "heat that is not": (QueueState, "_rewind", lambda state, ended, *_: state._go_back(ended[0]), withdraw_the_first),
    "light that is missing": (QueueState, "_drop_from", lambda state, row: state.running, stream_four),
    "not counted": (QueueState, "accept", lambda state, plan: KEPT_ACCEPT(state, plan).know(state.thermal), accept_two),
}
"""What the judge says, the transition with its mutant, and what happens."""


@pytest.mark.parametrize("message", MUTANTS)
def test_a_wrong_transition_is_caught(message):
    place, name, mutant, happen = MUTANTS[message]
    machine = QueueMachine()
    machine.patch.setattr(place, name, mutant)
    happen(machine)
    with pytest.raises(AssertionError, match=message):
        machine.teardown()


def test_a_plan_that_never_began_leaves_no_heat_when_the_link_is_lost():
    """The host stalls beyond its start until the lease has ended, before the queue could hand it over."""
    machine = QueueMachine()
    machine.accept_frame(20, 30.0)
    for stall_s in (0.03, 0.03, 0.03):
        machine.report_late(stall_s, True)
    machine.teardown()
    assert [push.record.status for push in machine.pushed] == ["failed"]
