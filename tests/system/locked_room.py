"""As much of the unit's walls as bubblewrap can build where systemd does not run as the first process.

Nothing of systemd is started: `systemd-analyze syscall-filter` prints what its sets of system calls hold, libseccomp
makes the filter of them.
"""

import ctypes
import ctypes.util
import re
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import optodrive
from optodrive.device.config import locate_shipped
from rig import OPTODRIVE

SCMP_ACT_ALLOW = 0x7FFF0000
SCMP_ACT_EPERM = 0x00050001


@cache
def why_not():
    """Why there is no locked room here; None where there is."""
    for program in ("bwrap", "systemd-analyze"):
        if shutil.which(program) is None:
            return f"{program} is missing: apt-get install {'bubblewrap' if program == 'bwrap' else 'systemd'}"
    if ctypes.util.find_library("seccomp") is None:
        return "libseccomp is missing: apt-get install libseccomp2"
    tried = subprocess.run(["bwrap", "--ro-bind", "/", "/", "--unshare-user", "true"], capture_output=True, text=True)
    return f"bubblewrap may not make a room here: {tried.stderr.strip()}" if tried.returncode else None


def locked(folder, writable):
    """A program in `folder` that runs optodrive in the room, where only `writable` may be written."""
    filtered = folder / "calls.bpf"
    write_filter(filtered)
    program = folder / "locked-optodrive"
    # Where the checkout lies in /tmp it must be seen all the same.
    seen = " ".join(f"--ro-bind {place} {place}" for place in (sys.prefix, Path(optodrive.__file__).parents[1]))
    program.write_text(
        f"#!/bin/sh\nexec 9<{filtered}\nexec bwrap --die-with-parent --ro-bind / / --tmpfs /tmp --tmpfs /run {seen} "
        f"--bind {folder} {folder} --remount-ro {folder} --bind {writable} {writable} "
        "--dev-bind /dev /dev --proc /proc --unshare-ipc --unshare-uts --unshare-cgroup-try "
        f'--cap-drop ALL --seccomp 9 -- {OPTODRIVE} "$@"\n'
    )
    program.chmod(0o755)
    return program


def write_filter(path):
    """The unit's SystemCallFilter= as a program for the kernel: what it does not name is answered with EPERM."""
    library = ctypes.CDLL(ctypes.util.find_library("seccomp"))
    library.seccomp_init.restype = ctypes.c_void_p
    context = ctypes.c_void_p(library.seccomp_init(ctypes.c_uint32(SCMP_ACT_EPERM)))
    assert context
    for name in sorted(allowed_calls()):
        number = library.seccomp_syscall_resolve_name(name.encode())
        if number >= 0:
            result = library.seccomp_rule_add_array(context, ctypes.c_uint32(SCMP_ACT_ALLOW), number, 0, None)
            assert result == 0, name
    with path.open("wb") as file:
        assert library.seccomp_export_bpf(context, file.fileno()) == 0
    library.seccomp_release(context)


def allowed_calls():
    """The system calls that the unit allows, its sets taken apart."""
    allowed = set()
    unit = locate_shipped("systemd", "optodrive.service").read_text()
    for line in re.findall(r"^SystemCallFilter=(.+)$", unit, re.MULTILINE):
        calls = {call for word in line.lstrip("~").split() for call in taken_apart(word)}
        allowed = allowed - calls if line.startswith("~") else allowed | calls
    # systemd lets a service be started at all: what is done before the program runs is done under the filter here.
    return allowed | {"execve", "prctl", "seccomp"}


@cache
def taken_apart(word):
    """A call, or all calls of a set."""
    if not word.startswith("@"):
        return frozenset({word})
    listed = subprocess.run(["systemd-analyze", "syscall-filter", word], capture_output=True, text=True, check=True)
    lines = [line.strip() for line in listed.stdout.splitlines()[1:]]
    words = [line for line in lines if line and not line.startswith("#")]
    return frozenset(call for inner in words for call in taken_apart(inner))
