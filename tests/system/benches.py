"""Fixtures: a board's process, a daemon on it, commands, all ended whatever happens."""

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
    """Start an `optodrive` command on a board."""
    commands = []

    def start_command(board, *arguments):
        commands.append(Command(tmp_path, board, *arguments))
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
def at_rest(kept):
    """One board and one daemon for all tests of a module, before each of them disarmed; the log begins anew."""
    board, daemon = kept
    daemon.call("POST", "/v1/stop")
    board.forget()
    return kept


@pytest.fixture(name="board")
def board_at_rest(at_rest):
    """In place of a new one, where a module imports it."""
    return at_rest[0]


@pytest.fixture(name="daemon")
def daemon_at_rest(at_rest):
    """In place of a new one, where a module imports it."""
    return at_rest[1]
