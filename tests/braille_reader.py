"""An unmodified BRLTTY on a braille display's port, and a program that writes through it by BrlAPI."""

import ctypes
import os
import random
import shutil
import socket
import subprocess

from optodrive.core.child_process import die_with_parent
from rig import wait_for

BRLAPI = "libbrlapi.so.0.8"
SOCKET_MIN, SOCKET_MAX = 100, 60_000
ROUTING_KEY = 0x2001_0000
"""Key code of a routing key, whose lowest bits are the cell from 0."""


def is_installed():
    """Return whether BRLTTY and its library are installed."""
    try:
        ctypes.CDLL(BRLAPI)
    except OSError:
        return False
    return shutil.which("brltty") is not None


def claim_socket():
    """Return a number of a socket of BrlAPI that no other test of this computer has, and what keeps it until closed."""
    while True:
        number, claim = random.randrange(SOCKET_MIN, SOCKET_MAX), socket.socket(socket.AF_UNIX)
        try:
            claim.bind(f"\0optodrive-brlapi-{number}")
        except OSError:
            claim.close()
            continue
        return number, claim


class BrlttyProcess:
    """BRLTTY with the given driver; its home is the folder."""

    def __init__(self, folder, *driver):
        number, self._claim = claim_socket()
        self.host = f":{number}"
        self._log = (folder / "brltty.log").open("a")
        folders = [option for flag in "WU" for option in (f"-{flag}", str(folder))]
        self.process = subprocess.Popen(
            [
                *("brltty", "-n", "-e", "-E", "-f", "/dev/null", "-s", "no", "-l", "info", *driver),
                *("-A", f"host={self.host},auth=none", *folders),
            ],
            env={**os.environ, "HOME": str(folder)},
            stdout=self._log,
            stderr=self._log,
            preexec_fn=die_with_parent,  # on a port that is gone it would take half a processor
        )

    def kill(self):
        """End it at once."""
        self.process.kill()
        self.process.wait()
        self._log.close()
        self._claim.close()


def drive_serial(port):
    """Return the options for one line at a serial port, without a screen."""
    return "-b", "hw", "-d", f"serial:{port}", "-x", "no"


def drive_lines(number, key_file):
    """Return the options for several lines at a server of BrlAPI, with a screen of braille ASCII in shared memory."""
    server = f"ba:host=127.0.0.1:{number},auth=keyfile:{key_file}"
    return "-b", "ba", "-B", server, "-x", "sc", "-t", "brf"


class Settings(ctypes.Structure):
    _fields_ = (("auth", ctypes.c_char_p), ("host", ctypes.c_char_p))


class Writer:
    """A program that has the whole display of a BRLTTY."""

    def __init__(self, brltty):
        self._library = ctypes.CDLL(BRLAPI)
        self._handle = ctypes.create_string_buffer(self._library.brlapi_getHandleSize())
        settings = Settings(b"none", brltty.host.encode())

        def connect():
            return self._call("openConnection", ctypes.byref(settings), None) >= 0

        wait_for(connect, "BrlAPI")
        width, height = ctypes.c_uint(), ctypes.c_uint()

        def has_display():
            self._call("getDisplaySize", ctypes.byref(width), ctypes.byref(height))
            return width.value * height.value

        wait_for(has_display, "the display")
        self.count = width.value * height.value
        assert self._call("enterTtyModeWithPath", None, 0, None) >= 0

    def _call(self, name, *arguments):
        return getattr(self._library, f"brlapi__{name}")(self._handle, *arguments)

    def write(self, cells):
        """Show cells."""
        assert self._call("writeDots", cells.ljust(self.count, b"\0")) == 0

    def read_key(self):
        """Return the code of a key that was pressed, None if none was."""
        code = ctypes.c_uint64()
        return code.value if self._call("readKey", 0, ctypes.byref(code)) == 1 else None

    def close(self):
        """End the connection."""
        self._call("closeConnection")
