"""Two boards with one trigger: they begin together, however far their oscillators drift apart.

Each board lives in the time of its own oscillator. The edges have true times, which each board meets at a tick of its
own; its pulses are compared in true time.
"""

import random
from functools import partial

import pytest
from bench import BRIGHT, Bench, here
from independent_board import independent_kind
from trigger_scenarios import TRIGGER, await_trigger, read_triggers
from virtual_board import VirtualKind

from c_core import SeededCBoard, build_library
from optodrive.link.simulator.board_core import BoardCore

PPM = 50
EVERY_S = 3.6
BEGIN_S = 10.0
DELAY_US, DARK_US = 1000, 500
TICK_US = 1.0
DRIFT_US = (DELAY_US + DARK_US) * 2 * PPM * 1e-6
"""What two clocks may differ in from an edge to its light."""


@pytest.fixture(scope="module")
def kinds(tmp_path_factory):
    """Kinds of boards by name. "late" counts the delay from the tick that notices the edge."""
    folder = tmp_path_factory.mktemp("core")
    c, late = (partial(SeededCBoard, build_library(folder, mutant)) for mutant in (0, 109))
    return {
        "python": VirtualKind("python", BoardCore),
        "c": VirtualKind("c", c),
        "late": VirtualKind("late", late),
        "independent": independent_kind(),
    }


class DriftingBoard:
    """A board whose oscillator is off by ppm, and its host."""

    def __init__(self, kind, folder, ppm, edges, **limits):
        self.bench = Bench(kind, folder)
        self.host = self.bench.ready(*[TRIGGER] * edges, **BRIGHT, **limits)
        self._rate = 1.0 + ppm * 1e-6

    def let_edge_come(self, true_s):
        """Wait until a true time, and let an edge come then."""
        host = self.host
        host.lease()
        host.clock.sleep(int(true_s * self._rate * 1e6) * 1e-6 - host.clock.now_s())
        host.board.next_step()
        host.pause(0.02)

    def list_true_us(self):
        """Return the true times of all pulses' begins, µs."""
        return [pulse["on_us"] / self._rate for pulse in self.host.board.of("pulse")]


def play_on_edges(kind, folder, ppm, edges_s):
    """Play a job of one pulse for each edge. Return the true times of the pulses, µs."""
    drifting = DriftingBoard(kind, folder, ppm, len(edges_s))
    for edge_s in edges_s:
        assert await_trigger(drifting.host, here(300, dark_us=DARK_US, duty=999), delay_us=DELAY_US) == []
        drifting.let_edge_come(edge_s)
    times_us = drifting.list_true_us()
    drifting.bench.finish(lambda board: None)
    assert len(times_us) == len(edges_s)
    return times_us


def measure_apart_us(one, other, folder, count):
    """Return the largest difference of the begins of two boards on one trigger, µs."""
    rng = random.Random(1)
    edges_s = [BEGIN_S + EVERY_S * k + rng.random() for k in range(count)]
    boards = [(one, PPM), (other, -PPM)]
    begun = [play_on_edges(kind, folder, ppm, edges_s) for kind, ppm in boards]
    return max(abs(first - second) for first, second in zip(*begun, strict=True))


@pytest.mark.parametrize("pair", [("python", "c"), ("c", "c"), ("c", "independent")], ids="-".join)
def test_two_boards_begin_within_a_tick(kinds, tmp_path, pair):
    apart_us = measure_apart_us(*(kinds[name] for name in pair), tmp_path, count=8)
    assert apart_us <= TICK_US + DRIFT_US


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("pair", [("python", "python"), ("python", "c")], ids="-".join)
def test_two_boards_begin_within_a_tick_for_an_hour(kinds, tmp_path, pair):
    apart_us = measure_apart_us(*(kinds[name] for name in pair), tmp_path, count=1000)
    print(f"{apart_us:.3f} µs apart at most in 1,000 jobs of an hour, oscillators {2 * PPM} ppm apart")
    assert apart_us <= TICK_US + DRIFT_US


def test_a_board_that_begins_when_it_notices_is_seen(kinds, tmp_path):
    assert measure_apart_us(kinds["python"], kinds["late"], tmp_path, count=3) > 50 * TICK_US


def test_a_start_tick_alone_drifts_apart(kinds, tmp_path):
    """The reason for the trigger: two boards that were in step begin 100 ppm of the time since then apart."""
    begun = []
    for ppm in (PPM, -PPM):
        drifting = DriftingBoard(kinds["python"], tmp_path, ppm, 0)
        host = drifting.host
        assert host.play(here(300, duty=999), start_tick=int(20e6)) == []
        host.clock.sleep(20.0)
        begun += drifting.list_true_us()
        drifting.bench.finish(lambda board: None)
    assert abs(begun[0] - begun[1]) == pytest.approx(20e6 * 2 * PPM * 1e-6, rel=0.01)


@pytest.mark.parametrize("name", ["python", "c", "independent"])
def test_a_reference_clock_states_the_ratio_of_two_clocks(kinds, tmp_path, name):
    ticks = []
    for ppm in (PPM, -PPM):
        drifting = DriftingBoard(kinds[name], tmp_path, ppm, 61)
        answers = []
        for k in range(61):
            drifting.let_edge_come(BEGIN_S + k)
            if k in (0, 60):
                answers.append(read_triggers(drifting.host))
        assert answers[1].count - answers[0].count == 60
        ticks.append(answers[1].tick - answers[0].tick)
        drifting.bench.finish(lambda board: None)
    assert ticks[0] / ticks[1] == pytest.approx((1 + PPM * 1e-6) / (1 - PPM * 1e-6), abs=2 / 60e6)
