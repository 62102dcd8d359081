"""Heat, starts and delays of every plan in the queue are those of the board's log, and no true report is called false.

Random sequences of frames that stand or are streamed, plans, withdrawals, pauses, dimming, fingers and stalls of the
host, with the real session over a simulated board in virtual time. The judge integrates the log by itself.
"""

from contextlib import suppress

import numpy as np
import pytest

from link_service_rig import WEB
from optodrive.core.errors import OptodriveError
from optodrive.core.types.fingers import FingerPlace
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.daemon.engine import queue_state
from optodrive.daemon.engine.plan_queue import PlanQueue
from optodrive.daemon.engine.queue_state import PlanRun, QueueState
from standing_rig import StandingRig, build_display, build_page

CAPS = ({}, {"display_mean_power_max_w": 0.2}, {"pixel_mean_power_max_w": 0.2}, {"touch_max_c": 41.0})
DISPLAYS = [build_display(**caps) for caps in CAPS]
SHIPPED = DISPLAYS[0]
PIXELS = len(SHIPPED.layout)
TICK_S = 1e-6
START_ERROR_MAX_S = 2.5 * TICK_S
"""Rounding of starts and delays to ticks."""
HEIGHT_ERROR_MAX_M = 2e-8
"""Rounding of times and powers on the wire."""
WIDTH_ERROR_MAX = 0.02
CUT_ERROR_MAX_M = 5e-6
CUT_KNOWN_AFTER_S = 0.4
"""When within a pulse a cancelled plan went dark is estimated, by the way to the board: too late, never too early."""
SECONDS = (0.002, 0.01, 0.03, 0.06, 0.15, 0.4)
STEPS = {
    "stand": 5,
    "send_again": 2,
    "end_page": 1,
    "stream": 3,
    "newest": 1,
    "play": 2,
    "train": 1,
    "cancel": 1,
    "pause": 1,
    "dim": 2,
    "touch": 2,
    "planning": 2,
    "stall": 1,
}
"""Steps of a sequence with their weights."""


class RecordingQueue(PlanQueue):
    """Keeps every run that has ended its plan."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.ended = []

    def _apply(self, state):
        jobs = {run.plan.plan_id: run.job for run in self.state.running}
        self.ended += [PlanRun(plan, jobs[plan.plan_id]) for plan, *_ in state.ended if plan.plan_id in jobs]
        super()._apply(state)


class Scene:
    """A random sequence of steps on a display. In two of three the host never stalls."""

    def __init__(self, monkeypatch, seed):
        self.rng = np.random.default_rng(seed)
        display = DISPLAYS[max(0, int(self.rng.integers(-2, len(DISPLAYS))))]
        self.rig = StandingRig(monkeypatch, display, queue_type=RecordingQueue).ready()
        self.rig.arm()
        self.rig.run(0.02)
        self.cancelled_s = []
        self.places, self.stalls, self.may_stall = (), 0, seed % 3 == 0

    def run(self):
        self.do_stand()
        names, weights = list(STEPS), np.array(list(STEPS.values())) / sum(STEPS.values())
        for name in self.rng.choice(names, int(self.rng.integers(4, 12)), p=weights):
            with suppress(OptodriveError):  # refused, as during a pause
                getattr(self, f"do_{name}")()
            self.wait(float(self.rng.choice(SECONDS)))
        self.rig.page_m = None
        self.rig.until(lambda: not self.rig.queue.is_busy or self.rig.core.state in ("FAULT", "DISARMED"), 60.0)
        self.rig.run(0.1)
        return self

    def wait(self, seconds):
        until_s = self.rig.clock.now_s() + seconds
        while self.rig.clock.now_s() < until_s:
            if self.places:
                self.rig.touch(self.places)
            self.rig.run()

    def build(self):
        count = int(self.rng.choice([1, 2, 3, 6, 12, 60]))
        height_um = self.rng.choice([20.0, 50.0, 150.0, 350.0, 500.0])
        pixels = np.random.default_rng(self.rng.integers(2)).choice(PIXELS, count, replace=False)
        return build_page(SHIPPED, pixels, height_um)

    def submit(self, sequence, **options):
        self.rig.submit(sequence, self.rig.remote.epoch, **options).result()

    def do_stand(self):
        self.rig.show(self.build())

    def do_send_again(self):
        if self.rig.page_m is not None:
            period_s = float(self.rng.choice([0.05, 0.1, 0.3]))
            self.rig.stand(self.rig.page_m, 3 * period_s, period_s, self.places)

    def do_end_page(self):
        self.rig.end_page()

    def do_stream(self):
        self.rig.page_m = None
        for _ in range(int(self.rng.integers(1, 8))):
            frame = TactileFrame("f", 0.0, 3600.0, self.build())
            self.submit(FrameSequence((frame,)), streamed=True, lists_pulses=False)
            self.wait(float(self.rng.choice([0.01, 0.02, 0.05, 0.1])))

    def do_newest(self):
        self.submit(FrameSequence((TactileFrame("f", 0.0, 3600.0, self.build()),)), streamed=True)

    def do_play(self):
        page_m = self.build()
        self.submit(FrameSequence(tuple(TactileFrame(str(k), 0.1 * k, 0.1, page_m) for k in range(3))))

    def do_train(self):
        pixel = int(self.rng.integers(20))
        self.submit(FrameSequence((), (PulseTrain(pixel, 0.0, 0.3, 0.01, 0.01, 1.0),)))

    def do_cancel(self):
        active = [*self.rig.queue.state.waiting, *(run.plan for run in self.rig.queue.state.running)]
        if active:
            self.cancelled_s.append(self.rig.clock.now_s())
            self.rig.queue.cancel(active[int(self.rng.integers(len(active)))].record)

    def do_pause(self):
        for command in ("pause", "resume"):
            self.rig.await_result(WEB, self.rig.request(WEB, command))
            self.wait(float(self.rng.choice(SECONDS)))

    def do_dim(self):
        self.rig.dimmer.set_share(self.rng.choice([0.3, 0.7, 1.0]))

    def do_touch(self):
        pixel, layout = int(self.rng.integers(-PIXELS // 2, PIXELS)), SHIPPED.layout
        self.places = (FingerPlace(1, float(layout.x_m[pixel]), float(layout.y_m[pixel]), 4e-3),) if pixel >= 0 else ()

    def do_planning(self):
        self.rig.planning_s = float(self.rng.choice([0.0, 0.002, 0.008, 0.02]))

    def do_stall(self):
        """Neither link process nor planner runs for a while."""
        if self.may_stall:
            self.stalls += 1
            self.rig.clock.sleep(float(self.rng.choice([0.01, 0.03, 0.06])))


def check_no_report_is_refused(rig):
    aborted = [entry for entry in rig.list_events("state") if entry["reason"] == "abort"]
    assert not aborted, rig.service.epoch.reason


class Pixel:
    """One pixel by its two linear equations, solved between the edges of light: absorber and gas, K."""

    def __init__(self, pixels, number):
        names = ("r_k_per_w", "c_j_per_k", "epsilon", "tau_g_s", "kappa_m_per_k")
        self.r, c, self.epsilon, self.tau_s, self.kappa = (float(getattr(pixels, name)[number]) for name in names)
        self.rc_s = self.r * c
        self.at_s, self.state = 0.0, (0.0, 0.0)

    def find_state(self, time_s, power_w=0.0):
        """Return the state a time after the last edge, or at several times [t]."""
        absorber_k, gas_k = self.state
        settled_k = self.epsilon * power_w * self.r
        fast, slow = np.exp(-time_s / self.tau_s), np.exp(-time_s / self.rc_s)
        driven_k = 0.5 * (absorber_k - settled_k) / (1.0 - self.tau_s / self.rc_s)
        rest_k = gas_k - 0.5 * settled_k - driven_k
        return settled_k + (absorber_k - settled_k) * slow, 0.5 * settled_k + driven_k * slow + rest_k * fast

    def advance(self, to_s, power_w=0.0):
        self.state, self.at_s = self.find_state(to_s - self.at_s, power_w), to_s

    def find_height_m(self, at_s):
        return self.kappa * self.find_state(at_s - self.at_s)[1]


class Log:
    """The pulses of a board's log with their pixels, and the heat that they bring.

    starts_s: [n]; pixels: [n]; of_index: row of each by the number of its point
    """

    def __init__(self, rig):
        self.display = rig.display
        layout, scale = rig.display.layout, rig.remote.scales[0]
        angle = 1.0 / (2.0 * rig.display.config.scanner.focal_length_m)
        codes = zip(*(scale.to_codes(at_m * angle).tolist() for at_m in (layout.x_m, layout.y_m)), strict=True)
        pixel_of = {code: pixel for pixel, code in enumerate(codes)}
        events = [event for event in rig.log if event["event"] == "pulse"]
        self.pixels = np.array([pixel_of[event["x"], event["y"]] for event in events], dtype=int)
        self.starts_s = np.array([event["on_us"] for event in events]) * TICK_S
        self.ends_s = np.array([event["off_us"] for event in events]) * TICK_S
        self.powers_w = np.array([event["duty"] for event in events]) * scale.full_power_w / 65535
        self.of_index = {event["index"]: row for row, event in enumerate(events)}

    def find_pixel(self, number, before_s):
        """Return a pixel after its last pulse that begins before a time."""
        pixel = Pixel(self.display.pixels, number)
        for row in np.flatnonzero((self.pixels == number) & (self.starts_s < before_s)).tolist():
            pixel.advance(self.starts_s[row])
            pixel.advance(self.ends_s[row], self.powers_w[row])
        return pixel

    def find_needed_share(self, row, target_m):
        """Return by which factor the power of a pulse brings its pixel to a height, from the heat at its start.

        1 if the height is right but for the rounding on the wire.
        """
        before, after = (
            self.find_pixel(int(self.pixels[row]), self.starts_s[row] + late_s) for late_s in (0.0, TICK_S)
        )
        times_s = self.ends_s[row] + np.linspace(0.0, 0.1, 2001)
        without_m, with_m = before.find_height_m(times_s), after.find_height_m(times_s)
        peak = int(np.argmax(with_m))
        if abs(with_m[peak] - target_m) <= HEIGHT_ERROR_MAX_M:
            return 1.0
        return (target_m - without_m[peak]) / (with_m[peak] - without_m[peak])


def judge(scene):
    """Compare all plans that were executed with the board's log."""
    rig = scene.rig
    check_no_report_is_refused(rig)
    log, is_late = Log(rig), scene.stalls > 0
    claimed = [row for run in rig.queue.ended for row in check_times(run, log, is_late)]
    assert len(claimed) == len(set(claimed))
    for run in rig.queue.ended if not is_late else ():
        if run.plan.executed_before and not run.plan.first_row:
            after_s = run.plan.record.start_s - np.array([-np.inf, *scene.cancelled_s])
            is_known = not np.any((after_s > 0.0) & (after_s < CUT_KNOWN_AFTER_S))
            check_heat(run.plan, log, HEIGHT_ERROR_MAX_M if is_known else CUT_ERROR_MAX_M)
            if is_known:
                check_widths(run, log)


def check_times(run, log, is_late):
    """Check the starts and the delay of a plan. Return the log's rows that belong to it."""
    plan, (part,) = run.plan, run.job.parts
    reports = part.read_reports(np.arange(part.pulse_count))
    has_light = reports.on_ticks > 0
    points = part.first_index + part._pulse_points[has_light]
    rows = [log.of_index[int(point)] for point in points]
    assert log.starts_s[rows] == pytest.approx(reports.on_tick[has_light] * TICK_S, abs=0.1 * TICK_S)
    late_s = log.starts_s[rows] - plan.record.start_s - plan.planned.plan.start_s[reports.row[has_light]]
    if len(rows):
        assert (late_s >= -START_ERROR_MAX_S).all()
        assert late_s.max() <= max(plan.record.delay_s, 0.0) + START_ERROR_MAX_S
        assert is_late or late_s.max() <= START_ERROR_MAX_S
    return rows


def check_heat(plan, log, error_max_m):
    """Check that the heat from which a plan was made is that of the log when it begins, and never less."""
    state = plan.before.heat.state_at(0.0)
    begin_s = plan.record.start_s
    for number in set(log.pixels.tolist()):
        pixel = log.find_pixel(number, begin_s - START_ERROR_MAX_S)
        error_m = state.displacement_m[number] - pixel.find_height_m(begin_s)
        assert -HEIGHT_ERROR_MAX_M <= error_m <= error_max_m, f"{plan.record.plan_id}, pixel {number}: {error_m:.3g} m"


def check_widths(run, log):
    """Check that each pulse by height has the width that the heat at its start needs."""
    plan, (part,) = run.plan.planned.plan, run.job.parts
    reports = part.read_reports(np.arange(part.pulse_count))
    for position, row, on_ticks in zip(part._pulse_points, reports.row, reports.on_ticks, strict=True):
        is_whole = on_ticks == round(plan.width_s[row] / TICK_S)
        if is_whole and np.isfinite(plan.target_m[row]) and not plan.reason[row] and plan.width_s[row] < 0.0499:
            share = log.find_needed_share(log.of_index[int(part.first_index + position)], plan.target_m[row])
            assert share == pytest.approx(1.0, abs=WIDTH_ERROR_MAX)


CANCELLED_BEFORE_ANOTHER = (2005, 2045, 2776)
"""A running plan is cancelled while another waits behind it."""
TRIMMED_TO_NOTHING = 2449
"""A plan of pulses trimmed to nothing is followed by another."""


DELAYED_AT_ITS_START = 9990
"""A plan that waits starts later than it was planned for."""


@pytest.mark.parametrize("seed", [*range(4), 2000, TRIMMED_TO_NOTHING, *CANCELLED_BEFORE_ANOTHER, DELAYED_AT_ITS_START])
def test_the_queue_follows_the_board(monkeypatch, seed):
    judge(Scene(monkeypatch, seed).run())


def go_back_to_the_first(state, ended, light, at=0):
    """Mutant: the light of plans that end early is forgotten."""
    return state._go_back(ended[0])._continue_from(at, state.end_s, light)


def rewind_the_last_plan_only(state, *arguments):
    """Mutant: plans that wait begin from the heat of pulses that were cut."""
    return state if state.waiting else KEPT_REWIND(state, *arguments)


def forget_unreported(plans, *arguments):
    """Mutant: light that was not reported yet is forgotten."""
    return KEPT_REWIND_ESTIMATE(plans, *arguments[:3])


KEPT_REWIND, KEPT_REWIND_ESTIMATE = QueueState._rewind, queue_state.rewind_estimate
MUTANTS = {
    "a plan that was never executed": (QueueState, "_go_back", lambda state, plan: state, 22),
    "light that was emitted": (QueueState, "_rewind", go_back_to_the_first, 2000),
    "light that is not reported yet": (queue_state, "rewind_estimate", forget_unreported, 2000),
    "light that was cut": (QueueState, "_rewind", rewind_the_last_plan_only, 2776),
}


@pytest.mark.parametrize("heat", MUTANTS)
def test_wrong_heat_is_caught(monkeypatch, heat):
    """Mutants."""
    place, name, mutant, seed = MUTANTS[heat]
    monkeypatch.setattr(place, name, mutant)
    scene = Scene(monkeypatch, seed).run()
    with pytest.raises(AssertionError):
        judge(scene)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("piece", range(100))
def test_the_queue_follows_the_board_in_ten_thousand_sequences(monkeypatch, piece):
    for seed in range(100 * piece, 100 * (piece + 1)):
        try:
            judge(Scene(monkeypatch, seed).run())
        except BaseException as error:
            error.add_note(f"seed {seed}")
            raise
