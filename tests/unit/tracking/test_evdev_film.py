"""A film at the Linux input layer: paths that are none."""

import sys
from pathlib import Path

import pytest

from optodrive.core.errors import InputError
from optodrive.tracking.camera import Camera
from optodrive.tracking.evdev_film import EvdevFilm, is_device


@pytest.mark.parametrize(
    ("path", "found"),
    [("/dev/null", "got Inappropriate ioctl for device"), ("/dev/input/event999", "got No such file or directory")],
)
def test_a_path_that_is_no_film_is_refused_in_one_line(tmp_path, path, found):
    with pytest.raises(InputError, match=f"{path}: {found}, expected a multitouch film"):
        EvdevFilm(tmp_path / path)


def test_a_device_is_told_from_a_recording(tmp_path):
    assert is_device(tmp_path / "/dev/null")
    assert not is_device(tmp_path)
    assert not is_device(tmp_path / "none")


def test_another_processor_than_x86_64_is_told_to_build_evdev(monkeypatch):
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    monkeypatch.setattr("optodrive.tracking.evdev_film.find_spec", lambda name: None)
    needs = "evdev: missing, expected `pip install evdev`, which needs a compiler and the kernel's headers on aarch64"
    with pytest.raises(InputError, match=needs):
        EvdevFilm(Path("/dev/null"))


@pytest.mark.parametrize(
    ("module", "name", "open_source"),
    [("evdev", "evdev", lambda: EvdevFilm(Path("/dev/null"))), ("cv2", "OpenCV", lambda: Camera("0"))],
)
def test_without_its_library_a_tracker_says_how_to_install_it(module, name, open_source, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError) as refused:
        open_source()
    assert str(refused.value) == f"{name}: missing, expected the extra: pip install 'optodrive[tracking]'"
