"""The map from a film to the display."""

import numpy as np
import pytest

from optodrive.core.errors import InputError
from optodrive.device.config import build_pixel_layout
from optodrive.device.config_file import load_config
from optodrive.tracking.contacts import Contact
from optodrive.tracking.film import (
    FilmRecording,
    choose_corner_pixels,
    iterate_touches,
    locate_contacts,
    replay_contacts,
)
from optodrive.tracking.film_calibration import fit_film, load_film_calibration, normalize, write_film_calibration
from touch_film import SimulatedFilm

DISPLAY = load_config().display
LAYOUT = build_pixel_layout(DISPLAY)
PLACES_M = np.column_stack([LAYOUT.x_m, LAYOUT.y_m])
CORNERS = choose_corner_pixels(LAYOUT)
AIM_M = 1e-3
"""Standard deviation of a person's touch from a pixel, per axis."""


def record_touches(path, film=None, pixels=CORNERS, aim_m=AIM_M, seed=2):
    """Record touches at pixels by a person who aims with an error."""
    film, random, end_s = film or SimulatedFilm(), np.random.default_rng(seed), 0.0
    for pixel in pixels:
        end_s = film.touch(end_s, PLACES_M[pixel] + aim_m * random.standard_normal(2))
    return FilmRecording(film.write(path))


def calibrate(recording, pixels=CORNERS):
    touches = np.array(list(iterate_touches(replay_contacts(recording))))
    return fit_film(recording.axes, touches, PLACES_M[list(pixels)])


def read_a_page(film, speed_m_per_s=0.1):
    """Two fingers, 18 mm apart, read line after line. Return their paths."""

    def find(offset_m):
        def place_m(at_s):
            line, rest_s = divmod(at_s, 1.5)
            x_m = -0.06 + speed_m_per_s * rest_s
            return (x_m - offset_m, 0.05 - 0.012 * line) if rest_s < 1.2 else None

        return place_m

    fingers = {"index": find(0.0), "middle": find(0.018)}
    film.move(0.0, 9.0, fingers)
    return fingers


def test_a_hand_that_reads_is_located_within_a_pitch_in_95_of_100(tmp_path):
    film = SimulatedFilm(seed=11)
    fingers = read_a_page(film)
    recording = FilmRecording(film.write(tmp_path / "hand.evemu"))
    errors_m = []
    for seed in range(8):  # persons that calibrate the film
        calibration = calibrate(record_touches(tmp_path / "touches.evemu", seed=seed))
        for report in locate_contacts(replay_contacts(recording), calibration):
            true_m = [place for place in (find(report.at_s + 1e-9) for find in fingers.values()) if place is not None]
            if len(true_m) == len(report.places) == 2:
                errors_m += [min(np.hypot(p.x_m - x, p.y_m - y) for x, y in true_m) for p in report.places]
    assert len(errors_m) > 9000
    p95_m = float(np.quantile(errors_m, 0.95))
    print(f"film: {1e3 * np.median(errors_m):.2f} mm median, {1e3 * p95_m:.2f} mm p95")
    assert p95_m <= DISPLAY.pitch_m


def test_residual_and_map_are_those_of_the_film(tmp_path):
    film = SimulatedFilm(noise_m=0.0)
    calibration = calibrate(record_touches(tmp_path / "touches.evemu", film, aim_m=0.0))
    assert calibration.residual_m < 5e-5
    for place_m in ((0.0, 0.0), (0.07, -0.03)):
        (found,) = calibration.locate((Contact(3, *film.measure(place_m).tolist()),))
        assert (found.number, *found[1:3]) == (
            3,
            pytest.approx(place_m[0], abs=5e-5),
            pytest.approx(place_m[1], abs=5e-5),
        )


def test_a_contact_outside_the_axes_has_no_place(tmp_path):
    calibration = calibrate(record_touches(tmp_path / "touches.evemu"))
    assert calibration.locate((Contact(1, 2**31, 0), Contact(2, 5000, 0), Contact(3, 4100, 10)))[0].number == 3
    assert calibration.locate(()) == ()


def test_brushes_and_touches_of_two_fingers_are_no_touches(tmp_path):
    film = SimulatedFilm()
    end_s = film.touch(0.0, (0.0, 0.0), seconds=0.1)
    end_s = film.touch(end_s, (0.01, 0.0))
    end_s = film.move(end_s, 0.5, {"a": lambda _: (0.0, 0.02), "b": lambda t: (0.04, 0.0) if t > end_s + 0.3 else None})
    film.report(end_s, {})
    film.touch(end_s + 0.3, (0.02, 0.0))
    recording = FilmRecording(film.write(tmp_path / "touches.evemu"))
    touches = list(iterate_touches(replay_contacts(recording)))
    expected = [film.measure((x_m, 0.0)) for x_m in (0.01, 0.02)]
    assert np.abs(np.array(touches) - expected).max() < 40


@pytest.mark.parametrize(
    ("pixels", "change", "message"),
    [
        (CORNERS[:2], lambda t: t, "touches: got 2, expected at least 3"),
        (range(30, 35), lambda t: t, "pixels on one line"),
        (CORNERS, lambda t: t[[0, 2, 1, 3]], "mm from their pixels (rms), expected at most 2 mm"),
        (CORNERS[:3], lambda t: t[0] + 0.2 * (t - t[0]), "length of the film's x axis"),
        (CORNERS[:3], lambda t: t[0] + np.outer([0, 9, 18], [1, 1]), "touches on one line"),
    ],
)
def test_touches_that_define_no_map_are_refused(tmp_path, pixels, change, message):
    recording = record_touches(tmp_path / "touches.evemu", pixels=pixels)
    touches = np.array(list(iterate_touches(replay_contacts(recording))))
    with pytest.raises(InputError) as refused:
        fit_film(recording.axes, change(touches), PLACES_M[list(pixels)])
    assert message in str(refused.value)


def test_a_film_that_does_not_state_its_size_may_have_any_but_not_a_metre(tmp_path):
    recording = record_touches(tmp_path / "touches.evemu")
    axes = recording.axes._replace(x=recording.axes.x._replace(per_mm=0), y=recording.axes.y._replace(per_mm=0))
    touches = np.array(list(iterate_touches(replay_contacts(recording))))
    places_m = PLACES_M[list(CORNERS)]
    assert fit_film(axes, touches, places_m).residual_m < 2e-3
    with pytest.raises(InputError, match=r"corner .* from the centre"):
        fit_film(axes, touches[0] + 0.1 * (touches - touches[0]), places_m)


def test_the_file_holds_the_calibration_and_refuses_another_film_and_version(tmp_path):
    calibration = calibrate(record_touches(tmp_path / "touches.evemu"))
    path = tmp_path / "film.toml"
    write_film_calibration(path, calibration)
    loaded = load_film_calibration(path, calibration.axes)
    assert np.abs(loaded.matrix - calibration.matrix).max() < 1e-9
    other = calibration.axes._replace(name="Other", x=calibration.axes.x._replace(maximum=99))
    with pytest.raises(
        InputError, match="axes of 'Film, 10 fingers', 0 to 4095 and 0 to 4095, expected those of 'Other'"
    ):
        load_film_calibration(path, other)
    text = path.read_text()
    for old, new, message in (
        ("version = 1", "version = 2", "version: got 2, expected 1"),
        ('"optodrive-film"', '"optodrive-field"', "format: got 'optodrive-field'"),
        ("x_m = [", "x_m = [9.0, ", "x_m"),
        ("slots = 10", "slot = 10", "nearest is 'slots'"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(InputError, match=message):
            load_film_calibration(path, calibration.axes)


def test_normalized_points_span_the_axes(tmp_path):
    axes = record_touches(tmp_path / "touches.evemu").axes
    assert normalize(axes, np.array([[0.0, 4095.0]])).tolist() == [[0.0, 1.0, 1.0]]
