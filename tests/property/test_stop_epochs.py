"""Nothing accepted before a STOP is emitted after the next arming, for any interleaving of possible actions.

Pushes are accepted at any moment, in the epoch that the web process sees then, and handed over at any later one. Each
has its own duty, so the board's log tells whose points it emits. Two gates each keep the property alone only in part:
without either of them the same interleavings break it. Ten thousand interleavings take three minutes of one core.

Nothing is emitted while the light is paused, and nothing after a pause that the planner built before it. The same
interleavings break without the pause's gate.
"""

import random
import time
from dataclasses import replace

import pytest

from link_service_rig import OPERATOR, PLANNER, REQUIREMENTS, SUPERVISOR, WEB, CuttableLink, ServiceRig
from optodrive.core.ipc import IpcError
from optodrive.link.protocol.states import BoardState
from optodrive.link.service.control import Epoch, Pauses
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.guards import DEFAULT_LIMITS, BoardSettings
from wire_points import build_points

LEASE_S = 0.5
SETTINGS = BoardSettings(limits=replace(DEFAULT_LIMITS, lease_ms=round(LEASE_S * 1e3)))
PATIENT = replace(REQUIREMENTS, lease_s=LEASE_S, limits=replace(REQUIREMENTS.limits, lease_ms=round(LEASE_S * 1e3)))
LONG_STEP_S = 0.1
SEND_AHEAD_S = 0.04
ACTIONS = 40
IN_EVERY_RUN, MANY = 60, 10_000
INPUTS = {"interlock": (False, True), "key": (False, True), "estop": (True, False)}
"""Unsafe and safe value of each input."""


class Interleaving:
    """One random interleaving.

    accepted: epoch of each push by its duty
    waiting: pushes not yet handed over
    built: number of the latest pause that the planner knew when it built a push's points
    pauses: time of each answered pause, and of its end, with the number of the pause and whether it lasts
    """

    def __init__(self, seed):
        self.random = random.Random(seed)
        self.rig = ServiceRig(link_type=CuttableLink, settings=SETTINGS, requirements=PATIENT).hello_all()
        self.accepted, self.waiting, self.last_count, self.last_job = {}, [], 0, 0
        self.epochs = [(0.0, self.rig.epoch)]
        self.built, self.pauses = {}, [(0.0, 0, False)]
        self.rig.connect()

    def run(self):
        for _ in range(ACTIONS):
            name = self.random.choices(list(WEIGHTS), WEIGHTS.values())[0]
            getattr(self, name)()
            self.rig.run(self.random.choice((0.0, 0.0, 0.002, 0.01, 0.05)))
            self._note_epoch()
        self.rig.link.is_cut = False
        self.resume()
        self.arm()
        self.hand_over()
        self.rig.run(0.3, 0.01)
        return self

    def _note_epoch(self):
        if self.epochs[-1][1] != self.rig.epoch:
            self.epochs.append((self.rig.clock.now_s(), self.rig.epoch))
            self._note_end_of_pause()

    def _note_end_of_pause(self):
        _, number, lasts = self.pauses[-1]
        if lasts:
            self.pauses.append((self.rig.clock.now_s(), number, False))

    # --- actions

    def accept(self):
        duty = len(self.accepted) + 1
        self.accepted[duty] = self.rig.epoch
        self.waiting.append((duty, self.rig.epoch))

    def hand_over(self):
        if self.waiting:
            duty, epoch = self.waiting.pop(self.random.randrange(len(self.waiting)))
            ahead_s = self.random.choice((None, SEND_AHEAD_S))
            self.last_count = self.random.choice((1, 5, 60))
            points = build_points(self.last_count, duty)
            start_in_s, pause = self.random.choice((0.005, 0.05)), self.build(duty)
            self.last_job = self.rig.begin(points, epoch, start_in_s, ahead_s, pause=pause)

    def build(self, duty):
        """Return the pause after which the planner has built points, which may be an earlier one."""
        latest = self.rig.pause_number
        self.built[duty] = latest if self.random.random() < 0.8 else self.random.randint(0, latest)
        return self.built[duty]

    def splice(self):
        if self.waiting:
            duty, epoch = self.waiting.pop(self.random.randrange(len(self.waiting)))
            kept_points = self.random.randint(0, self.last_count)
            try:
                points = build_points(20, duty)
                number, result = self.rig.splice(points, kept_points, epoch, SEND_AHEAD_S, pause=self.build(duty))
            except IpcError:  # more than the last job's points: the process ends such a planner's connection
                self.lose_planner()
                return
            if result["error"] is None and result["start_tick"] is not None:
                self.last_count, self.last_job = 20, number

    def extend(self):
        if self.waiting:
            duty, epoch = self.waiting.pop(self.random.randrange(len(self.waiting)))
            result = self.rig.extend(self.last_job, build_points(20, duty), epoch, pause=self.build(duty))
            self.last_count += 20 if result["error"] is None and result["done"] else 0

    def truncate(self):
        self.rig.request(PLANNER, "truncate", kept_points=[self.random.choice((0, 20, 50))])

    def flush(self):
        self.rig.send(PLANNER, "flush")

    def pause(self):
        request_id = self.rig.request(WEB, "pause")
        for _ in range(self.random.choice((0, 5))):
            self.rig.run()
        self._note_epoch()
        result = self.rig.find_result(WEB, request_id)
        if result and result["error"] is None and result["epoch"] == self.rig.epoch:
            self.pauses.append((self.rig.clock.now_s(), self.rig.pause_number, True))

    def resume(self):
        self.rig.request(WEB, "resume")
        self._note_end_of_pause()

    def stop(self):
        self.rig.request(self.random.choice((PLANNER, WEB, OPERATOR, SUPERVISOR)), "stop")
        self._note_epoch()
        if self.random.random() < 0.5:
            self.rig.run()
            if self.rig.session.connected and not self.rig.link.is_cut:
                assert self.rig.core.state in (BoardState.DISARMED, BoardState.FAULT)

    def disarm(self):
        self.rig.request(self.random.choice((WEB, SUPERVISOR)), "disarm")
        self._note_epoch()

    def fault(self):
        name = self.random.choice(list(INPUTS))
        unsafe, safe = INPUTS[name]
        self.rig.core.set_input(name, unsafe, self._now_us())
        self.rig.run(self.random.choice((0.0, 0.01)))
        self.rig.core.set_input(name, safe, self._now_us())

    def reset_board(self):
        self.rig.core.reset(self._now_us())

    def lose_link(self):
        self.rig.link.is_cut = True
        self.rig.run(self.random.choice((0.01, 0.2, 2.5)), LONG_STEP_S)
        self.rig.link.is_cut = False
        self.rig.run(self.random.choice((0.01, 1.5)), LONG_STEP_S)

    def lose_planner(self):
        self.rig.leave(PLANNER)
        self._note_epoch()
        self.rig.run(self.random.choice((0.0, 0.01)))
        self.rig.hello(PLANNER, "planner")

    def lose_web(self):
        self.rig.leave(WEB)
        self._note_epoch()
        self.rig.run(self.random.choice((0.0, 0.01)))
        self.rig.hello(WEB, "web")

    def withhold_beats(self):
        client = self.random.choice((PLANNER, WEB))
        self.rig.alive[client] = None
        self.rig.run(2.0, LONG_STEP_S)
        self.rig.alive[client] = True

    def arm(self):
        if self.rig.session.board.state == BoardState.FAULT:
            self.disarm()
            self.rig.run(0.01)
        request_id = self.rig.request(WEB, "arm")
        if self.random.random() < 0.1:
            return  # the next action interrupts the arming
        for _ in range(25):
            self.rig.run(LONG_STEP_S, LONG_STEP_S)
            self._note_epoch()
            if self.rig.find_result(WEB, request_id):
                return

    def _now_us(self):
        return round(self.rig.clock.now_s() * 1e6)

    # --- verdict

    def find_unpaused(self):
        """Return (duty, built after, emitted at, in) of the pulses that a pause should have kept dark."""
        unpaused = []
        for event in self.rig.log:
            if event["event"] != "pulse":
                continue
            on_s, built = event["on_us"] * 1e-6, self.built[event["duty"]]
            _, number, lasts = next(pause for pause in reversed(self.pauses) if pause[0] <= on_s)
            if lasts or built < number:
                unpaused.append((event["duty"], built, on_s, number))
        return unpaused

    def find_epoch(self, at_s):
        return next(epoch for since_s, epoch in reversed(self.epochs) if since_s <= at_s)

    def find_stale(self):
        """Return (duty, accepted in, emitted in) of the pulses of an epoch other than that of the board's arming."""
        stale, armed_in = [], None
        for event in self.rig.log:
            if (
                event["event"] == "state"
                and event["state"] == BoardState.ARMED
                and event["before"] == BoardState.ARMING
            ):
                armed_in = self.find_epoch(event["t_us"] * 1e-6)
            elif event["event"] == "pulse" and self.accepted[event["duty"]] != armed_in:
                stale.append((event["duty"], self.accepted[event["duty"]], armed_in))
        return stale


WEIGHTS = {
    "accept": 11,
    "hand_over": 8,
    "splice": 3,
    "extend": 3,
    "truncate": 1,
    "flush": 1,
    "pause": 3,
    "resume": 4,
    "stop": 4,
    "disarm": 2,
    "fault": 1,
    "reset_board": 0.3,
    "lose_link": 0.3,
    "lose_planner": 1,
    "lose_web": 1,
    "withhold_beats": 0.3,
    "arm": 6,
}


def count_pulses(seeds):
    """Run interleavings, require the property of each, and return how many pulses they have emitted."""
    pulses = 0
    for seed in seeds:
        interleaving = Interleaving(seed).run()
        assert interleaving.find_stale() == [], f"interleaving {seed}"
        assert interleaving.find_unpaused() == [], f"interleaving {seed}"
        pulses += len(interleaving.rig.list_emitted())
    return pulses


def test_nothing_of_an_older_epoch_is_emitted():
    assert count_pulses(range(IN_EVERY_RUN)) > IN_EVERY_RUN


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_nothing_of_an_older_epoch_is_emitted_in_many_interleavings():
    begin_s = time.perf_counter()
    pulses = count_pulses(range(IN_EVERY_RUN, IN_EVERY_RUN + MANY))
    print(f"\n{MANY} interleavings, {pulses} pulses, {time.perf_counter() - begin_s:.0f} s")


def gate_1_accepts_every_epoch(patch):
    patch.setattr(Epoch, "is_current", lambda epoch, number: True)


def gate_2_arming_keeps_points(patch):
    patch.setattr(BoardSession, "_drop_held_points", lambda session: None)
    patch.setattr(BoardSession, "describe_lateness", lambda session: "")  # arming takes so long that they are late


@pytest.mark.parametrize("mutant", [gate_1_accepts_every_epoch, gate_2_arming_keeps_points])
def test_the_property_catches_a_missing_gate(mutant, monkeypatch):
    mutant(monkeypatch)
    assert any(Interleaving(seed).run().find_stale() for seed in range(IN_EVERY_RUN))


def gate_of_the_pause_is_missing(patch):
    patch.setattr(Pauses, "permits", lambda pauses, number: True)


def gate_of_the_pause_forgets_earlier_ones(patch):
    patch.setattr(Pauses, "permits", lambda pauses, number: not pauses.is_paused)


@pytest.mark.parametrize("mutant", [gate_of_the_pause_is_missing, gate_of_the_pause_forgets_earlier_ones])
def test_the_property_catches_a_missing_gate_of_the_pause(mutant, monkeypatch):
    mutant(monkeypatch)
    assert any(Interleaving(seed).run().find_unpaused() for seed in range(IN_EVERY_RUN))
