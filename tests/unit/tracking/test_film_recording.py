"""Recordings of a film in evemu's format."""

from itertools import pairwise

import pytest

from optodrive.core.errors import InputError
from optodrive.tracking.contacts import FilmAxis
from optodrive.tracking.film import REPEAT_S, FilmRecorder, FilmRecording, replay_contacts
from touch_film import SimulatedFilm

AXES = "A: 2f 0 9 0 0 0\nA: 35 0 99 0 0\nA: 36 0 99 0 0 10\n"
HEAD = f"# EVEMU 1.2\nN: Film\n{AXES}"
EVENTS = "E: 1.0 0003 0039 0001\nE: 1.0 0003 0035 0002\nE: 1.0 0003 0036 0003\nE: 1.0 0000 0000 0000\n"


@pytest.fixture
def film():
    film = SimulatedFilm()
    film.move(0.0, 1.0, {"a": lambda t: (0.05 * t, 0.0), "b": lambda t: (0.0, 0.03 * t) if t > 0.5 else None})
    film.report(1.2, {})
    return film


def test_reads_what_evemu_records(film, tmp_path):
    recording = FilmRecording(film.write(tmp_path / "hand.evemu"))
    assert recording.axes == ("Film, 10 fingers", 10, FilmAxis(0, 4095, 20), FilmAxis(0, 4095, 20))
    assert [event[1:] for event in recording.events] == [event[1:] for event in film.events]
    assert [event.at_s for event in recording.events] == pytest.approx([event[0] for event in film.events], abs=2e-6)


def test_reads_what_the_recorder_wrote(film, tmp_path):
    recording = FilmRecording(film.write(tmp_path / "hand.evemu"))
    with FilmRecorder(tmp_path / "again.evemu", recording.axes) as recorder:
        recorder.write(event._replace(at_s=event.at_s + 5e5) for event in recording.events)
    again = FilmRecording(tmp_path / "again.evemu")
    assert (again.axes, [event[1:] for event in again.events]) == (
        recording.axes,
        [event[1:] for event in recording.events],
    )
    assert [event.at_s for event in again.events] == pytest.approx([e.at_s for e in recording.events], abs=2e-6)


def test_a_recorder_replaces_no_file(film, tmp_path):
    path = film.write(tmp_path / "hand.evemu")
    with pytest.raises(InputError, match="expected a new file"):
        FilmRecorder(path, FilmRecording(path).axes)


def test_contacts_that_stay_are_repeated_and_lifted_at_the_end(tmp_path):
    path = tmp_path / "hand.evemu"
    path.write_text(HEAD + EVENTS + "E: 1.5 0003 0035 0004\nE: 1.5 0000 0000 0000\n")
    reports = list(replay_contacts(FilmRecording(path)))
    assert max(later.at_s - earlier.at_s for earlier, later in pairwise(reports)) <= REPEAT_S + 1e-9
    assert [report.contacts for report in reports if report.at_s < 0.5] == [((1, 2, 3),)] * 13
    assert [report.contacts for report in reports if report.at_s >= 0.5] == [((1, 4, 3),), ()]


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("time_s,number\n", "another format"),
        (HEAD, "no event"),
        ("# EVEMU 1.2\n" + EVENTS, "axes without slots"),
        (HEAD + EVENTS + "E: 1 2\n", "line 10: got 'E: 1 2'"),
        (HEAD + "E: x 0000 0000 0000\n", "line 6"),
        (HEAD + "E: nan 0000 0000 0000\n", "line 6"),
        (HEAD + "E: 1.0 0000 0000 99999999999\n", "line 6"),
        (HEAD + EVENTS + "E: 0.5 0000 0000 0000\n", "decreasing"),
        (HEAD.replace("0 99", "99 0") + EVENTS, "axis 35: got '99 0 0 0', expected a minimum and a maximum"),
        (HEAD.replace("2f 0 9", "2f 9999999999 9") + EVENTS, "axis 2f"),
    ],
)
def test_a_wrong_recording_is_refused_by_its_line(tmp_path, text, place):
    path = tmp_path / "hand.evemu"
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        FilmRecording(path)
    assert place in str(refused.value)
