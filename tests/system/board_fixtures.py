"""Fixtures for board processes, daemons and commands, all of which end with the test."""

import pytest

from rig import Board, Command, Daemon, running


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
def start(tmp_path):
    """Return a function that starts an `optodrive` command on a board."""
    commands = []

    def start_command(board, *arguments, **options):
        commands.append(Command(tmp_path, board, *arguments, **options))
        return commands[-1]

    yield start_command
    for command in commands:
        command.stop()


@pytest.fixture
def board(make_board):
    return make_board()


@pytest.fixture
def daemon(make_daemon, board):
    return make_daemon(board)


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    with running(tmp_path_factory.mktemp("kept")) as board_and_daemon:
        yield board_and_daemon


@pytest.fixture
def disarmed(kept):
    """One board and one daemon for all tests of a module, disarmed and with a cleared log before each test."""
    board, daemon = kept
    daemon.call("POST", "/v1/stop")
    board.forget()
    return kept


@pytest.fixture(name="board")
def board_disarmed(disarmed):
    """Shared fixture that replaces the per-test one in modules that import it."""
    return disarmed[0]


@pytest.fixture(name="daemon")
def daemon_disarmed(disarmed):
    """Shared fixture that replaces the per-test one in modules that import it."""
    return disarmed[1]
