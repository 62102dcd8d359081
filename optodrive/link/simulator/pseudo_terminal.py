"""A pseudo-terminal in place of a serial port, under a stable name."""

import os
import tty
from pathlib import Path

from optodrive.core.errors import InputError


def check_link_path(option: str, link: Path) -> None:
    """Raise InputError, naming the option, if the link cannot be created."""
    if not link.parent.is_dir():
        raise InputError(option, str(link), "a name in a folder that exists")
    if link.exists() and not link.is_symlink():
        raise InputError(option, str(link), "a name that is free, or a link")


def open_pty(link: Path) -> int:
    """Open a pty and return the descriptor of its instrument end, non-blocking. link: name that the host opens."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    temporary = link.with_name(link.name + ".new")
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(os.ttyname(slave))
    temporary.replace(link)
    os.close(slave)  # from now on a hang-up means that no host has the port open
    return master


def remove_link(link: Path, terminal: Path) -> None:
    """Remove a link that open_pty() has created, unless another instrument has its name by now."""
    if link.is_symlink() and link.readlink() == terminal:
        link.unlink()
