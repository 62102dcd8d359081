"""The paper's six experiments over REST, executed with its timings (Text S5, Fig. S17)."""

from functools import cache, partial

import numpy as np
import pytest

from optodrive.device.config import build_pixel_layout
from optodrive.device.config_file import load_config
from optodrive.link.board_setup import build_board_requirements
from optodrive.planning.stimuli.experiments import build_two_fingers
from rig import running

PWM_S = 2e-4


@pytest.fixture(scope="module")
def options():
    """Options of board and daemon."""
    return {}


@pytest.fixture(scope="module")
def bench(tmp_path_factory, options):
    with running(tmp_path_factory.mktemp("experiments"), **options) as (board, daemon):
        daemon.arm()
        yield board, daemon


@pytest.fixture(scope="module")
def executed(bench):
    return partial(play, *bench)


def play(board, daemon, name, **parameters):
    plan = daemon.call("POST", f"/v1/patterns/{name}", json=parameters)["plan"]
    answer = daemon.finished(plan)
    assert answer["status"] == "done", answer["error"]
    assert answer["planned"] == answer["sent"] == answer["executed"]
    assert answer["executed_complete"]
    assert answer["summary"]["trimmed"]["pulses"] == 0
    columns = {key: np.array(value) for key, value in answer["executed_pulses"].items()}
    assert_logged(board, columns, daemon.state()["totals"]["executed"])
    columns["settling_s"] = answer["summary"]["settling_s"]
    columns["first_s"] = columns["start_s"] - columns["start_s"][0]
    columns["total_s"] = columns["first_s"][-1] + columns["width_s"][-1]
    return columns


def assert_logged(board, columns, executed_in_all):
    """Assert that the board's log has exactly these pulses, with their times, widths and cells, and ends gate off."""
    pulses = board.of("pulse")
    assert len(pulses) == executed_in_all
    pulses = pulses[-len(columns["pixel"]) :]
    on_us, off_us, codes, index = (
        np.array([[pulse[name] for name in names] for pulse in pulses])
        for names in (("on_us",), ("off_us",), ("x", "y"), ("index",))
    )
    assert np.allclose(np.diff(on_us[:, 0]) * 1e-6, np.diff(columns["start_s"]), atol=2e-6)
    assert (off_us - on_us)[:, 0].tolist() == np.rint(columns["width_s"] * 1e6).astype(int).tolist()
    assert (np.diff(index[:, 0]) > 0).all()
    assert codes.tolist() == cell_codes()[columns["pixel"]].tolist()
    assert not board.of("fault")
    edges = board.of("gate")[-2 * len(pulses) :]
    assert [edge["on"] for edge in edges] == [True, False] * len(pulses)


@cache
def cell_codes():
    """Return the codes of every pixel's centre, [p, 2]."""
    config = load_config()
    layout, angle = build_pixel_layout(config.display), 1.0 / (2.0 * config.scanner.focal_length_m)
    scale = build_board_requirements(config).scale
    return np.column_stack([scale.to_codes(layout.x_m * angle), scale.to_codes(layout.y_m * angle)])


def by_visit(pulses):
    """Return the pulse indices grouped by runs on one pixel."""
    return np.split(np.arange(len(pulses["pixel"])), np.flatnonzero(np.diff(pulses["pixel"])) + 1)


def assert_train(pulses, rows, width_s, gap_s):
    assert pulses["width_s"][rows] == pytest.approx(width_s, abs=PWM_S)
    gaps = np.diff(pulses["start_s"][rows]) - pulses["width_s"][rows[:-1]]
    assert gaps == pytest.approx(gap_s, abs=PWM_S)


def test_experiment_1_linear_motion(executed):
    pulses = executed("experiment-1", direction="right")
    visits = by_visit(pulses)
    assert len(visits) == 6
    for rows in visits:
        assert_train(pulses, rows, 0.020, 0.060)
    starts = [pulses["first_s"][rows[0]] for rows in visits]
    assert starts == pytest.approx([0.0, 0.3, 0.6, 1.4, 1.7, 2.0], abs=PWM_S + pulses["settling_s"])
    pixels = [int(pulses["pixel"][rows[0]]) for rows in visits]
    assert pixels[:3] == pixels[3:] == list(range(pixels[0], pixels[0] + 3))


@pytest.mark.parametrize(("speed", "slot_s"), [(16, 0.2), (32, 0.1), (64, 0.05)])
def test_experiment_2_rotation(executed, speed, slot_s):
    pulses = executed("experiment-2", direction="cw", speed=speed)
    visits = by_visit(pulses)
    assert len(visits) == 8
    for rows in visits:
        assert_train(pulses, rows, 0.025, 0.071)
    starts = [pulses["first_s"][rows[0]] for rows in visits]
    assert starts == pytest.approx(slot_s * np.arange(8), abs=PWM_S + pulses["settling_s"])


def test_experiment_3_localisation(executed):
    pulses = executed("experiment-3", target=3)
    reference, target = by_visit(pulses)
    for rows in (reference, target):
        assert len(rows) == 10
        assert_train(pulses, rows, 0.025, 0.025)
    assert pulses["first_s"][target[0]] == pytest.approx(0.5 + 0.75, abs=PWM_S + pulses["settling_s"])


@pytest.mark.parametrize(("level", "power_w"), [(1, 0.5), (5, 1.5), (9, 2.45)])
def test_experiment_4_intensity(executed, level, power_w):
    pulses = executed("experiment-4", level=level)
    assert len(pulses["pixel"]) == 20
    assert_train(pulses, np.arange(20), 0.025, 0.025)
    assert pulses["power_w"] == pytest.approx(power_w, rel=1e-4)
    assert pulses["total_s"] == pytest.approx(0.975, abs=PWM_S)


def test_experiment_5_temporal_patterns(executed):
    pulses = executed("experiment-5", oddball=2, kind="fast", pause_s=0.5)
    starts = pulses["first_s"]
    stimuli = np.split(np.arange(len(starts)), np.flatnonzero(np.diff(starts) > 0.3) + 1)
    assert len(stimuli) == 3
    for rows, half_s in zip(stimuli, (0.035, 0.010, 0.035), strict=True):
        assert_train(pulses, rows, half_s, half_s)
    assert [starts[rows[0]] for rows in stimuli] == pytest.approx([0.0, 0.9, 1.8], abs=PWM_S)


def test_experiment_6_two_fingers_interleaved(executed):
    pulses = executed("experiment-6", digits="2-3")
    assert len(pulses["pixel"]) == 40
    assert pulses["width_s"] == pytest.approx(0.015, abs=PWM_S)
    first, second = set(pulses["pixel"][0::2]), set(pulses["pixel"][1::2])
    assert len(first) == len(second) == 4
    assert not first & second
    assert pulses["pixel"].tolist() == pulses["pixel"][:8].tolist() * 5
    gaps_s = np.diff(pulses["start_s"]) - pulses["width_s"][:-1]
    assert gaps_s == pytest.approx(gaps_s.mean(), abs=PWM_S)
    trains = build_two_fingers(load_config(), "digits", "2-3", None).trains
    requested = sorted((start_s, train.pixel) for train in trains for start_s in train.pulse_starts_s())
    requested_s, pixels = zip(*requested, strict=True)
    assert pulses["pixel"].tolist() == list(pixels)
    assert pulses["first_s"] == pytest.approx(requested_s, abs=PWM_S)
    assert pulses["settling_s"] <= gaps_s.sum() + PWM_S < 0.04
