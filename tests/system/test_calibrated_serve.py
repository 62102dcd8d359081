"""`serve --field` and `serve --pixel-map`: the board's log has the codes of field and map."""

import numpy as np
import pytest

from hidden_field import CONFIG, LAYOUT, calibrate_hidden_field
from optodrive.device.calibrated_field import load_field
from optodrive.device.pixel_map import DEAD, MEASURED, PixelMap, write_pixel_map
from rig import Board, Daemon

PIXELS = (0, 20, 218, 400, 436)
DEAD_PIXEL, LOW = 218, 0


def shown(folder, *options):
    """Return the board's pulses of a frame of all PIXELS in order, and the daemon's response."""
    board = Board(folder)
    try:
        daemon = Daemon(folder, board.port, options=options)
        try:
            daemon.arm()
            frame = {"show_at_s": 0.0, "duration_s": 1.0, "target_um": {str(pixel): 60 for pixel in PIXELS}}
            answer = daemon.call("POST", "/v1/plans", json={"frames": [frame]})
            assert daemon.finished(answer["plan"])["status"] == "done"
        finally:
            daemon.stop()
        return board.of("pulse"), answer
    finally:
        board.stop()


@pytest.mark.parametrize("mapped", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_frame_uses_the_codes_of_field_and_map(tmp_path, mapped):
    """The map does not move pixels 0 and 20, so the field alone determines their codes."""
    path, map_path, count = tmp_path / "field.toml", tmp_path / "pixels.toml", len(LAYOUT)
    calibrate_hidden_field(path, seed=3)
    offset_m, gain, state = np.zeros((2, count)), np.ones(count), np.full(count, MEASURED)
    if mapped:
        offset_m[:, 200:] = np.random.default_rng(5).uniform(-1e-4, 1e-4, (2, count - 200))
        gain[LOW], state[DEAD_PIXEL] = 0.7, DEAD
    known = PixelMap(gain, gain * 0.01, *offset_m.copy(), *np.full((2, count), 1e-6), state, "surroundings")
    write_pixel_map(map_path, known, CONFIG, {})

    pulses, answer = shown(tmp_path, "--field", path, *(("--pixel-map", map_path) if mapped else ()))
    order = answer["pulses"]["pixel"]
    assert sorted(order) == [pixel for pixel in PIXELS if not known.dead[pixel]]
    places_m = np.array([LAYOUT.x_m, LAYOUT.y_m])[:, order]
    codes = np.column_stack(load_field(path).codes(*(places_m + offset_m[:, order])))
    landed = np.array([[pulse["x"], pulse["y"]] for pulse in pulses])
    assert np.abs(landed - codes).max() <= 0.51
    code_m = 2.0 * CONFIG.scanner.focal_length_m * CONFIG.scanner.rad_per_code
    assert np.abs(codes - (32768 + places_m.T / code_m)).max() > 100  # without the field the codes differ

    assert answer["summary"]["dead"]["message"] == (f"pixel {DEAD_PIXEL} is dead: omitted" if mapped else None)
    assert answer["pulses"]["predicted_um"] == pytest.approx([60.0] * len(order), rel=1e-3)
    energy_j = dict(zip(order, answer["pulses"]["energy_j"], strict=True))
    assert energy_j[LOW] / energy_j[20] == pytest.approx(1.4 if mapped else 1.0, abs=0.1)
