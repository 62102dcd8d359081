"""Contacts from events of multitouch protocol B."""

import numpy as np
import pytest

from optodrive.tracking import contacts
from optodrive.tracking.contacts import Contact, InputEvent, decode_contacts
from touch_film import DROPPED, SLOT, TRACKING, SimulatedFilm, X, Y


def decode(film):
    return list(decode_contacts(InputEvent(*event) for event in film.events))


def decode_events(*events):
    return [report.contacts for report in decode_contacts(InputEvent(0.0, *event) for event in events)]


def test_codes_are_those_of_the_kernel():
    ecodes = pytest.importorskip("evdev").ecodes
    names = [name for name in vars(contacts) if name.startswith(("ABS_", "EV_", "SYN_"))]
    assert len(names) == 8
    for name in names:
        assert getattr(contacts, name) == getattr(ecodes, name), name


def test_each_report_states_all_contacts_though_the_kernel_sends_changes_alone():
    film = SimulatedFilm(noise_m=0.0)
    film.report(0.0, {"a": (0.0, 0.0)})
    film.report(0.1, {"a": (0.0, 0.0), "b": (0.02, 0.0)})
    film.report(0.2, {"a": (0.01, 0.0), "b": (0.02, 0.0)})
    film.report(0.3, {"b": (0.02, 0.0)})
    film.report(0.4, {})
    first, second, third, fourth, last = decode(film)
    assert [len(report.contacts) for report in (first, second, third, fourth, last)] == [1, 2, 2, 1, 0]
    assert first.contacts == second.contacts[:1]
    assert second.contacts[1] == third.contacts[1] == fourth.contacts[0]
    assert third.contacts[0] == Contact(65530, *film.measure((0.01, 0.0)))
    assert [report.at_s for report in (first, last)] == [0.0, 0.4]


def test_a_reused_slot_keeps_the_place_that_the_kernel_does_not_repeat_and_gets_another_number():
    film = SimulatedFilm(noise_m=0.0)
    film.report(0.0, {"a": (0.0, 0.0)})
    film.report(0.1, {})
    film.report(0.2, {"b": (0.0, 0.0)})
    (a,), (), (b,) = (report.contacts for report in decode(film))
    assert (X in [event[2] for event in film.events[-3:]], b[1:], b.number) == (False, a[1:], a.number + 1)


def test_a_slot_that_goes_from_one_finger_to_the_next_in_one_report_changes_its_number():
    reports = decode_events((3, TRACKING, 5), (3, X, 1), (3, Y, 2), (0, 0, 0), (3, TRACKING, 6), (3, X, 9), (0, 0, 0))
    assert reports == [(Contact(5, 1, 2),), (Contact(6, 9, 2),)]


def test_a_contact_without_a_place_is_none_yet():
    assert decode_events((3, TRACKING, 5), (3, X, 1), (0, 0, 0), (3, Y, 2), (0, 0, 0)) == [(), (Contact(5, 1, 2),)]


def test_fingers_that_cross_keep_their_numbers():
    film = SimulatedFilm(noise_m=0.0)
    film.move(0.0, 1.0, {"a": lambda t: (0.05 * (2 * t - 1), 0.0), "b": lambda t: (0.05 * (1 - 2 * t), 0.001)})
    reports = decode(film)
    tracks = {
        number: np.array([c.x for r in reports for c in r.contacts if c.number == number]) for number in (65530, 65531)
    }
    assert [len(track) for track in tracks.values()] == [100, 100]
    for track, sign in zip(tracks.values(), (-1, 1), strict=True):  # the film is mirrored
        assert (sign * np.diff(track) > 0).all()


def test_numbers_wrap_and_nothing_else():
    film = SimulatedFilm()
    end_s = 0.0
    for _ in range(10):
        end_s = film.touch(end_s, (0.0, 0.0), seconds=0.05)
    numbers = [report.contacts[0].number for report in decode(film) if report.contacts]
    assert list(dict.fromkeys(numbers)) == [65530, 65531, 65532, 65533, 65534, 65535, 0, 1, 2, 3]


def cut_and_drop(film, first, last):
    """Lose events as the kernel does when its buffer overflows: what comes next up to a report is a fragment."""
    film.events[first:last] = [(film.events[first][0], *DROPPED)]


def test_after_dropped_events_contacts_are_those_that_the_kernel_states():
    film = SimulatedFilm(noise_m=0.0)
    film.report(0.0, {"a": (0.0, 0.0), "b": (0.03, 0.0)})
    lost = len(film.events)
    film.report(0.1, {"b": (0.03, 0.0)})  # a is lifted, c comes into its slot: lost
    film.report(0.2, {"b": (0.03, 0.0), "c": (0.05, 0.01)})
    fragment = len(film.events) - 2
    cut_and_drop(film, lost, fragment)
    film.restate(0.2)
    film.report(0.3, {"b": (0.04, 0.0), "c": (0.05, 0.01)})
    reports = decode(film)
    assert [report.at_s for report in reports] == [0.0, 0.2, 0.3]
    expected = [(number, *film.measure(place_m)) for number, place_m in ((65532, (0.05, 0.01)), (65531, (0.03, 0.0)))]
    assert reports[1].contacts == tuple(expected)
    assert reports[2].contacts[1] == (65531, *film.measure((0.04, 0.0)))


def test_after_dropped_events_without_a_statement_no_value_goes_to_a_slot_that_is_only_guessed():
    reports = decode_events(
        *((3, TRACKING, 5), (3, X, 1), (3, Y, 2), (0, 0, 0)),
        *(DROPPED, (3, X, 7), (0, 0, 0)),
        *((3, X, 8), (0, 0, 0)),
        *((3, SLOT, 1), (3, TRACKING, 6), (3, X, 3), (3, Y, 4), (0, 0, 0)),
    )
    assert reports == [(Contact(5, 1, 2),), (), (Contact(6, 3, 4),)]
