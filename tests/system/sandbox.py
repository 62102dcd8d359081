"""Sandbox with the restrictions of the systemd unit, built by bubblewrap, for machines not booted with systemd.

`systemd-analyze syscall-filter` lists the system calls of each set, and libseccomp builds the filter from them. No part
of systemd is started.
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
from optodrive.device.config_file import locate_shipped
from rig import OPTODRIVE

SCMP_ACT_ALLOW = 0x7FFF0000
SCMP_ACT_EPERM = 0x00050001


@cache
def find_obstacle():
    """Return why the sandbox is not available, None if it is."""
    for program in ("bwrap", "systemd-analyze"):
        if shutil.which(program) is None:
            return f"{program} is missing: apt-get install {'bubblewrap' if program == 'bwrap' else 'systemd'}"
    if ctypes.util.find_library("seccomp") is None:
        return "libseccomp is missing: apt-get install libseccomp2"
    tried = subprocess.run(["bwrap", "--ro-bind", "/", "/", "--unshare-user", "true"], capture_output=True, text=True)
    return f"bubblewrap cannot create a sandbox: {tried.stderr.strip()}" if tried.returncode else None


def build_sandboxed(folder, writable):
    """Create a program in `folder` that runs optodrive in the sandbox, where only `writable` is writable."""
    filtered = folder / "calls.bpf"
    write_filter(filtered)
    program = folder / "sandboxed-optodrive"
    # The checkout must be visible even if it is in /tmp.
    visible = " ".join(f"--ro-bind {place} {place}" for place in (sys.prefix, Path(optodrive.__file__).parents[1]))
    program.write_text(
        f"#!/bin/sh\nexec 9<{filtered}\nexec bwrap --die-with-parent --ro-bind / / --tmpfs /tmp --tmpfs /run {visible} "
        f"--bind {folder} {folder} --remount-ro {folder} --bind {writable} {writable} "
        "--dev-bind /dev /dev --proc /proc --unshare-ipc --unshare-uts --unshare-cgroup-try "
        f'--cap-drop ALL --seccomp 9 -- {OPTODRIVE} "$@"\n'
    )
    program.chmod(0o755)
    return program


def write_filter(path):
    """Write the unit's SystemCallFilter= as a kernel filter that answers all other calls with EPERM."""
    library = ctypes.CDLL(ctypes.util.find_library("seccomp"))
    library.seccomp_init.restype = ctypes.c_void_p
    context = ctypes.c_void_p(library.seccomp_init(ctypes.c_uint32(SCMP_ACT_EPERM)))
    assert context
    for name in sorted(list_allowed_calls()):
        number = library.seccomp_syscall_resolve_name(name.encode())
        if number >= 0:
            result = library.seccomp_rule_add_array(context, ctypes.c_uint32(SCMP_ACT_ALLOW), number, 0, None)
            assert result == 0, name
    with path.open("wb") as file:
        assert library.seccomp_export_bpf(context, file.fileno()) == 0
    library.seccomp_release(context)


def list_allowed_calls():
    """Return the system calls that the unit permits, with its sets expanded."""
    allowed = set()
    unit = locate_shipped("systemd", "optodrive.service").read_text()
    for line in re.findall(r"^SystemCallFilter=(.+)$", unit, re.MULTILINE):
        calls = {call for word in line.lstrip("~").split() for call in expand_set(word)}
        allowed = allowed - calls if line.startswith("~") else allowed | calls
    # Here the filter also applies to the start of the program, which systemd does before it applies the filter.
    return allowed | {"execve", "prctl", "seccomp"}


@cache
def expand_set(word):
    """Return a call, or all calls of a set."""
    if not word.startswith("@"):
        return frozenset({word})
    listed = subprocess.run(["systemd-analyze", "syscall-filter", word], capture_output=True, text=True, check=True)
    lines = [line.strip() for line in listed.stdout.splitlines()[1:]]
    words = [line for line in lines if line and not line.startswith("#")]
    return frozenset(call for inner in words for call in expand_set(inner))
