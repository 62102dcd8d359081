"""A pseudo-terminal that stands for a serial port, under a name of its own."""

import os
import tty
from pathlib import Path

from optodrive.core.errors import InputError


def check_link_path(option: str, link: Path) -> None:
    """InputError, naming the option, where a link cannot be put."""
    if not link.parent.is_dir():
        raise InputError(option, str(link), "a name in a folder that exists")
    if link.exists() and not link.is_symlink():
        raise InputError(option, str(link), "a name that is free, or a link")


def open_pty(link: Path) -> int:
    """The instrument's end, not blocking; link: the name that the host opens, put in place at once."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    temporary = link.with_name(link.name + ".new")
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(os.ttyname(slave))
    temporary.replace(link)
    os.close(slave)  # from here on a hang-up means that no host has the port open
    return master
