"""A service manager in place of systemd: it hears the daemon's notifications and requests reloads."""

import signal
import socket

from rig import wait_for


class Manager:
    """Receiver of notifications in place of systemd."""

    def __init__(self, folder, monkeypatch, watchdog_us=200_000):
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(folder / "notify"))
        self._socket.settimeout(0.01)
        self.heard = []
        monkeypatch.setenv("NOTIFY_SOCKET", str(folder / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", str(watchdog_us))

    def listen(self):
        while True:
            try:
                self.heard += self._socket.recv(4096).decode().split("\n")
            except TimeoutError:
                return self.heard

    def close(self):
        self._socket.close()


def reload(daemon, manager, edit):
    """Edit the configuration, request a reload and return the log line."""
    daemon.config.write_text(edit(daemon.config.read_text()))
    lines, ready = daemon.errors.read_text(), manager.listen().count("READY=1")
    daemon.process.send_signal(signal.SIGHUP)
    wait_for(lambda: manager.listen().count("READY=1") > ready, "the reload's end")
    assert "RELOADING=1" in manager.heard
    return daemon.errors.read_text().removeprefix(lines)
