"""A screen that BRLTTY reads: the shared memory of its driver for GNU screen, written by a test.

Format of BRLTTY 6.5, Drivers/Screen/Screen: columns, rows, column and row of the cursor, all text, all attributes, the
number of the screen and flags, each a byte. The memory's key belongs to the home folder.
"""

import ctypes

SIZE = 4 + 66 * 132 * 2
PROJECT = ord("b")
CREATE = 0o1000 | 0o700
REMOVE = 0
NUMBER = 1

_library = ctypes.CDLL(None, use_errno=True)
_library.shmat.restype = ctypes.c_void_p


class SharedScreen:
    """A screen of rows × columns for the BRLTTY whose home folder is `home`."""

    def __init__(self, home, rows, columns):
        self.rows, self.columns = rows, columns
        key = _library.ftok(str(home).encode(), PROJECT)
        self._identifier = _library.shmget(key, SIZE, CREATE)
        assert self._identifier >= 0, ctypes.get_errno()
        self._address = _library.shmat(self._identifier, None, 0)
        self.show([])

    def show(self, lines, cursor=(0, 0)):
        """Show lines of bytes from the top."""
        text = b"".join(line.ljust(self.columns) for line in lines).ljust(self.rows * self.columns)
        head = bytes([self.columns, self.rows, cursor[1], cursor[0]])
        data = head + text + b"\x07" * len(text) + bytes([NUMBER, 0])
        ctypes.memmove(self._address, data, len(data))

    def close(self):
        """Remove the memory."""
        _library.shmdt(ctypes.c_void_p(self._address))
        _library.shmctl(self._identifier, REMOVE, None)
