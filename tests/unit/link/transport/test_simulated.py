"""Simulated boards under one name: the terminal of one that has ended may be that of another program by now."""

import os

import pytest

from optodrive.link.transport.base import PortSettings
from optodrive.link.transport.simulated import SimulatedBoard


@pytest.fixture
def board(tmp_path):
    board = SimulatedBoard(PortSettings("simulated", str(tmp_path / "tty")))
    yield board
    board.release()


def test_a_link_that_an_earlier_board_has_left_is_not_opened(board, tmp_path):
    foreign, foreign_end = os.openpty()
    (tmp_path / "tty").symlink_to(os.ttyname(foreign_end))
    board.open()
    assert os.ttyname(board.fileno()) != os.ttyname(foreign_end)
    board.write(b"\0")
    os.set_blocking(foreign, False)
    with pytest.raises(BlockingIOError):
        os.read(foreign, 1)
    for descriptor in (foreign, foreign_end):
        os.close(descriptor)


def test_a_board_that_ends_keeps_the_link_of_its_successor(tmp_path):
    settings = PortSettings("simulated", str(tmp_path / "tty"))
    first, second = SimulatedBoard(settings), SimulatedBoard(settings)
    try:
        first.open()
        second.open()
        first.release()
        assert os.ttyname(second.fileno()) == str((tmp_path / "tty").readlink())
    finally:
        for board in (first, second):
            board.release()
    assert not (tmp_path / "tty").is_symlink()
