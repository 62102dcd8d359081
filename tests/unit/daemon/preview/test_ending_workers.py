"""A worker that was killed and takes long to die keeps nobody waiting but the next of its kind."""

import ctypes
import os

from test_preview import SMALL, assert_serves, build_slowly, start, wait_for  # noqa: F401 - a fixture

from optodrive.daemon.preview import jobs

PTRACE_SEIZE, WALL = 0x4206, 0x40000000


def hold_death(pid):
    """Let a process that is killed remain until `allow_death`: its tracer must have noticed its end first."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
    if libc.ptrace(PTRACE_SEIZE, pid, None, None) != 0:
        raise OSError(ctypes.get_errno(), "ptrace")


def allow_death(pid):
    while os.WIFSTOPPED(os.waitpid(pid, WALL)[1]):
        pass


def test_a_dropped_dry_run_that_dies_slowly_keeps_no_build_waiting(start, monkeypatch):  # noqa: F811
    monkeypatch.setattr(jobs, "make_plan", build_slowly)
    preview = start()
    preview.dry_run(1, SMALL)
    wait_for(preview.slow_workers)
    (first,) = preview.slow_workers()
    hold_death(first)
    preview.send("drop", 1)
    preview.dry_run(2, SMALL)
    assert_serves(preview)
    assert preview.slow_workers() == {first}, "two dry runs hold memory at once"
    allow_death(first)
    wait_for(lambda: preview.slow_workers() - {first})
