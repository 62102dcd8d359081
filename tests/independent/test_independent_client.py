"""The client in JavaScript plays its plan on the shipped boards, judged by their logs."""

import json
import subprocess
from functools import partial
from itertools import pairwise

import pytest
from bench import Bench
from emulated_pico import EmulatedPico, PicoImage
from emulated_usb_pico import EmulatedUsbPico
from independent_board import independent_kind
from independent_client import client_command, play
from link_faults import LinkFaults
from process_board import PROCESS_KINDS
from scenario import audit
from virtual_board import EmulatedBoard, PicoBoard, VirtualKind

from c_core import SeededCBoard, build_library
from firmware_ports import build_emulated_chip
from optodrive.link.simulator.board_core import BoardCore

PLAYED = ["boot", "arm requested", "armed", "start", "job done", "start", "job done", "disarm"]
PATIENT_MS = 60_000


@pytest.fixture(scope="module", params=["python", "c", "qemu", "independent"])
def kind(request, tmp_path_factory):
    if request.param == "python":
        return VirtualKind("python", BoardCore)
    if request.param == "independent":
        return independent_kind()
    if request.param == "qemu":
        return VirtualKind("qemu", build_emulated_chip(tmp_path_factory.mktemp("chip"), 0), make_board=EmulatedBoard)
    library = build_library(tmp_path_factory.mktemp("core"))
    return VirtualKind("c", lambda *settings, **seed: SeededCBoard(library, *settings, **seed))


def assert_played(board, report, *, in_time):
    """Compare a board's log with the plan: place, width and duty of each pulse, and each pause to the microsecond."""
    points = [point for job in report["jobs"] for point in job]
    expected = [(k, p["x"], p["y"], p["duty"], p["on_us"]) for k, p in enumerate(points) if p["on_us"]]
    pulses = board.of("pulse")
    assert [(p["index"], p["x"], p["y"], p["duty"], p["off_us"] - p["on_us"]) for p in pulses] == expected
    records = dict(report["records"])
    assert list(records) == list(range(len(points))), "reports that the client did not ask for again"
    shifts = {pulse["on_us"] - records[pulse["index"]]["tick"] for pulse in pulses}
    assert len(shifts) == 1, "the reports' times are not the log's"
    begin = 0
    for job, start_tick in zip(report["jobs"], report["startTicks"], strict=True):
        assert_pauses(job, [records[begin + k] for k in range(len(job))], report["hello"])
        if start_tick and in_time:
            assert records[begin]["tick"] == start_tick + settling_us(*points[begin - 1 : begin + 1], report["hello"])
        begin += len(job)
    assert report["refusals"] == []


def assert_pauses(job, records, limits):
    for (before, point), (earlier, record) in zip(pairwise(job), pairwise(records), strict=True):
        dark_us = record["tick"] - earlier["tick"] - earlier["on_ticks"]
        assert dark_us == max(point["dark_us"], settling_us(before, point, limits)), (point, record)


def settling_us(before, point, limits):
    distance = max(abs(point["x"] - before["x"]), abs(point["y"] - before["y"]))
    return limits["settle_us"] - -distance * limits["settle_ns_per_code"] // 1000 if distance else 0


def play_virtually(kind, folder, loss=0.0, seed=0, **settings):
    """Let the client play on a board of a kind. Return board, report and the faults of the line."""
    bench = Bench(kind, folder)
    board = bench.board(**settings)
    up, down = (LinkFaults(2 * seed + way, loss) for way in (0, 1))
    now_s = board.clock.now_s
    carried = {"carry_up": lambda data: up.carry(data, now_s()), "carry_down": lambda data: down.carry(data, now_s())}
    report = play(board.open(), board.clock, **carried)
    bench.finish(audit)
    return board, report, sum((up.counts + down.counts).values())


def test_its_plan_is_played_in_virtual_time(kind, tmp_path):
    board, report, _ = play_virtually(kind, tmp_path)
    assert [reason for _, reason in board.states()] == PLAYED
    assert_played(board, report, in_time=True)


@pytest.mark.slow
@pytest.mark.parametrize("pico", [EmulatedPico, EmulatedUsbPico])
def test_its_plan_is_played_by_a_pico(tmp_path, pico):
    built = tmp_path / "image"
    built.mkdir()
    kind = VirtualKind("pico", partial(pico, PicoImage(built)), make_board=PicoBoard)
    board, report, _ = play_virtually(kind, tmp_path)
    assert [reason for _, reason in board.states()] == PLAYED
    assert_played(board, report, in_time=True)


def test_points_beyond_the_queue_are_streamed(kind, tmp_path):
    board, report, _ = play_virtually(kind, tmp_path, queue_points=64)
    assert len(report["jobs"][0]) > 3 * 64
    assert [reason for _, reason in board.states()] == PLAYED
    assert_played(board, report, in_time=True)


@pytest.mark.parametrize("seed", range(3))
def test_lost_and_damaged_frames_change_nothing(kind, tmp_path, seed):
    board, report, faults = play_virtually(kind, tmp_path, loss=0.1, seed=seed, lease_ms=PATIENT_MS)
    assert faults > 10
    assert_played(board, report, in_time=False)


def test_a_board_that_moves_too_fast_is_caught(tmp_path):
    board, report, _ = play_virtually(independent_kind("B7"), tmp_path)
    with pytest.raises(AssertionError):
        assert_played(board, report, in_time=True)


@pytest.mark.parametrize("name", [kind.name for kind in PROCESS_KINDS])
def test_its_plan_is_played_on_a_process(name, tmp_path):
    (kind,) = [kind for kind in PROCESS_KINDS if kind.name == name]
    bench = Bench(kind.ready(tmp_path / "build"), tmp_path)
    board = bench.board(lease_ms=PATIENT_MS)
    output = subprocess.run(client_command(board.port), check=True, capture_output=True, text=True).stdout
    board.wait(lambda: [entry["open"] for entry in board.of("port")] == [True, False], "the end of the port")
    assert [reason for _, reason in board.states()] == PLAYED
    assert_played(board, json.loads(output), in_time=False)
    bench.finish(audit)


def test_a_plan_that_the_board_does_not_permit_is_refused_by_the_client(tmp_path):
    bench = Bench(PROCESS_KINDS[0], tmp_path)
    board = bench.board(max_duty=20_000)
    answer = subprocess.run(client_command(board.port), capture_output=True, text=True)
    assert answer.returncode == 1
    assert answer.stderr == "the board does not permit this plan: point 1 has duty 20037 of 20000\n"
    board.wait(lambda: len(board.of("port")) == 2, "the end of the port")
    assert [reason for _, reason in board.states()] == ["boot"]
    bench.finish(audit)
