import pytest

from optodrive.clock import MonotonicClock
from optodrive.config import load_config
from optodrive.daemon.engine import Engine
from optodrive.pipeline import Display
from optodrive.transport.simulated import SimulatedBoard
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


@pytest.fixture
def transport():
    return SimulatedBoard("", 1_000_000)


@pytest.fixture
def engine(transport):
    engine = Engine(Display.of(load_config()), transport, MonotonicClock())
    engine.start()
    yield engine
    engine.close()


@pytest.fixture
def armed(engine):
    engine.arm().result(10)
    return engine
