"""Scanners whose outputs are swapped and inverted: every point reaches its place, and spots name the wiring."""

from itertools import product

import numpy as np
import pytest

from dac.bench import build_config, raw_points
from exclusive_rig import ExclusiveRig
from hidden_field import CONFIG, calibrate_hidden_field, config_with_field, grid_codes
from optodrive.core.errors import InputError, LocalProtocolError
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.field_loader import load_scan_field
from optodrive.lab.calibration.spot_checks import check_spots
from optodrive.lab.calibration.spots import FieldPrior, MeasuredSpots
from optodrive.lab.commissioning.mirror_steps import plan_step_runs, play_step_runs
from optodrive.link.board_setup import build_scales
from optodrive.link.dac.encoding import PointScale, encode
from optodrive.link.protocol.quantisation import quantise
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence

CENTRE_CODE = 32768
WIRINGS = [
    dict(zip(("swap_axes", "invert_x", "invert_y"), each, strict=True)) for each in product([False, True], repeat=3)
]
MATRICES = {
    (False, False, False): [[1, 0], [0, 1]],
    (False, True, False): [[-1, 0], [0, 1]],
    (False, False, True): [[1, 0], [0, -1]],
    (False, True, True): [[-1, 0], [0, -1]],
    (True, False, False): [[0, 1], [1, 0]],
    (True, True, False): [[0, -1], [1, 0]],
    (True, False, True): [[0, 1], [-1, 0]],
    (True, True, True): [[0, -1], [-1, 0]],
}
"""Outputs X and Y of places along x and y, row by row."""


def wire(config, wiring):
    """Return the configuration with a wiring."""
    return config.model_copy(update={"scanner": config.scanner.model_copy(update=wiring)})


def place(outputs, wiring, centre=CENTRE_CODE):
    """Return the codes along x and y that a scanner of this wiring goes to, [n, 2], for those of its outputs."""
    matrix = np.array(MATRICES[tuple(wiring.values())])
    return np.linalg.solve(matrix, (np.asarray(outputs) - centre).T).T + centre


@pytest.mark.parametrize("wiring", WIRINGS)
def test_spots_and_steps_reach_their_places(display, wiring):
    moves = []
    rig = ExclusiveRig(
        DisplayModel.from_config(wire(display.config, wiring)), lambda x, y, at_us: moves.append((at_us, x, y))
    )
    with rig.armed() as held:
        for codes in ((CENTRE_CODE + 15_000, CENTRE_CODE - 4_000), (CENTRE_CODE - 7_000, CENTRE_CODE + 12_000)):
            held.fire_spot(*codes, 5e-3)
            pulse = rig.of("pulse")[-1]
            assert place([[pulse["x"], pulse["y"]]], wiring).tolist() == [list(codes)]
        for run in plan_step_runs(held, 6):
            moves.clear()
            play_step_runs((run,), held, 0.0, lambda run, commands: None)
            places = place([each[1:] for each in moves], wiring)
            kept = places[np.append(True, np.diff(places, axis=0).any(axis=1))]
            assert run.codes.tolist() in [kept[at : at + len(run.codes)].tolist() for at in range(len(kept))]


def read_outputs_of_board(plan, config):
    """Return the outputs of each pulse on the wire, and their centre."""
    points = quantise(plan, build_scales(config)[0])
    return points.table[points.row >= 0, :2].astype(float), CENTRE_CODE


def read_outputs_of_helios(plan, config):
    """Return the outputs of each pulse by the bytes of a Helios, two codes of 12 bits in three bytes; their centre."""
    points = [raw_points(chunk.data) for chunk in encode(plan, PointScale.from_config(config))]
    rows = np.concatenate(points).astype(int)
    emitting = rows[rows[:, 3:].any(axis=1)]
    outputs = np.column_stack(
        [emitting[:, 0] << 4 | emitting[:, 1] >> 4, (emitting[:, 1] & 15) << 8 | emitting[:, 2]]
    ).astype(float)
    return outputs[np.append(True, np.diff(outputs, axis=0).any(axis=1))], 2048


@pytest.mark.parametrize(
    ("config", "read_outputs"), [(CONFIG, read_outputs_of_board), (build_config(), read_outputs_of_helios)]
)
@pytest.mark.parametrize("wiring", WIRINGS)
def test_a_plan_lights_its_pixels(config, read_outputs, wiring):
    display = DisplayModel.from_config(wire(config, wiring))
    target = np.zeros(len(display.layout))
    target[[0, 3, 9]] = 20e-6
    frame = FrameSequence((TactileFrame("f", 0.0, 5.0, target),))
    plan = plan_sequence(display, frame, *display.build_cold_state()).plan
    aims_m = np.column_stack([display.layout.x_m, display.layout.y_m])[plan.pixel]
    outputs, centre = read_outputs(plan, display.config)
    code_m = 2.0 * config.scanner.focal_length_m * config.scanner.rad_per_code
    assert (place(outputs, wiring, centre) - centre) * code_m == pytest.approx(aims_m, abs=code_m)


@pytest.mark.parametrize("configured", WIRINGS)
def test_spots_of_another_wiring_name_it(configured):
    """The advice is taken, the display is measured again, and the spots pass."""
    code_m = 2.0 * CONFIG.scanner.focal_length_m * CONFIG.scanner.rad_per_code
    codes = grid_codes(5)
    for true in WIRINGS:

        def measure(wiring, true=true):
            matrix = np.array(MATRICES[tuple(wiring.values())])
            places = place(CENTRE_CODE + (codes - CENTRE_CODE) @ matrix.T, true)
            return MeasuredSpots.from_table(np.column_stack([codes, (places - CENTRE_CODE) * code_m]))

        prior = FieldPrior.from_config(wire(CONFIG, configured))
        if configured == true:
            check_spots("spots.csv", measure(configured), prior)
            continue
        with pytest.raises(InputError, match="x_m that increases with x_code") as caught:
            check_spots("spots.csv", measure(configured), prior)
        advised = str(caught.value).split("[scanner] ")[1].split(", ")
        assert {key: value == "true" for key, value in (each.split(" = ") for each in advised)} == true
        check_spots("spots.csv", measure(true), FieldPrior.from_config(wire(CONFIG, true)))


def test_a_field_of_another_wiring_is_refused(tmp_path):
    calibrate_hidden_field(tmp_path / "field.toml")
    load_scan_field(config_with_field(tmp_path / "field.toml"))
    with pytest.raises(
        InputError, match=r"scanner\.swap_axes: got 'true', expected false, as when .*; calibrate again"
    ):
        load_scan_field(config_with_field(tmp_path / "field.toml", swap_axes=True))


def test_a_code_without_an_inverse_is_refused():
    (scale,) = build_scales(wire(CONFIG, {"invert_y": True}))
    with pytest.raises(LocalProtocolError, match="code 0"):
        scale.to_outputs(np.array([0]), np.array([0]))
