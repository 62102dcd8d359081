"""A film at the Linux input layer: paths that are none."""

import pytest

from optodrive.core.errors import InputError
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
