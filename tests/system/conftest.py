import pytest

from rig import Board, Daemon


@pytest.fixture
def make_board(tmp_path):
    boards = []

    def make(**options):
        boards.append(Board(tmp_path, **options))
        return boards[-1]

    yield make
    for board in boards:
        board.stop()


@pytest.fixture
def make_daemon(tmp_path):
    daemons = []

    def make(board, **options):
        daemons.append(Daemon(tmp_path, board.port, **options))
        return daemons[-1]

    yield make
    for daemon in daemons:
        daemon.stop()


@pytest.fixture
def board(make_board):
    return make_board()


@pytest.fixture
def daemon(make_daemon, board):
    return make_daemon(board)
