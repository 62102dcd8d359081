"""A board and a daemon that the tests of a module share, and the actions of the tests on both."""

from rig import Board, Daemon, wait_for

INTERLOCK = """
[[step]]
from = "light"
at_s = 2.0
set = "interlock"
value = false

[[step]]
from = "light"
at_s = 3.0
set = "interlock"
value = true
"""
"""Script of a board whose interlock opens during light, and closes a second later."""
SAFE_INPUTS = 0b011  # interlock closed, key on, emergency stop released


class Bench:
    """Board and daemon."""

    def __init__(self, folder, display="display-437"):
        self.folder = folder
        self.is_plain = self.is_plain_daemon = True
        self.board = Board(folder)
        try:
            self.daemon = Daemon(folder, self.board.port, name=display)
        except BaseException:
            self.board.stop()
            raise

    def reset(self):
        """Bring both to a known state: a board without a script, linked, disarmed, without a fault."""
        if not self.is_plain or self.board.process.poll() is not None:
            self.replace_board()
            self.is_plain = True
        if not self.is_plain_daemon:
            self.restart_daemon()
        self.daemon.call("POST", "/v1/disarm")
        self.daemon.call("PUT", "/v1/dim", json={"share": 1.0})
        wait_for(lambda: self.daemon.board_state() == "DISARMED", "the board to be disarmed")
        self.board.forget()

    def replace_board(self, **options):
        """Replace the board by another one at the same port, and wait for the link to it."""
        self.is_plain = False
        self.board.stop()
        wait_for(lambda: self.daemon.state()["link"]["state"] == "down", "the loss of the link")
        self.board = Board(self.folder, **options)
        self.board.forget()
        wait_for(lambda: self.daemon.state()["link"]["state"] == "up", "the link")

    def restart_daemon(self, replace=()):
        """Start a daemon on the address of the one that was stopped. replace: changes of its configuration."""
        port = self.daemon.client.base_url.port
        self.daemon.stop()
        self.daemon = Daemon(self.folder, self.board.port, replace=replace, options=("--port", str(port)))
        self.is_plain_daemon = not replace

    def stop(self):
        self.daemon.stop()
        self.board.stop()
