"""Compilation of the limiter in two processes, where its machine code is not cached.

Theory of operation

Problem. A first plan compiles some 60 kernels one after the other, in half a minute on one core. Four fifths of that is
the limiter's: `apply_pulses` and what it calls.

Two halves. Numba compiles a kernel with all that it calls, and one thread at a time may compile. But a kernel whose
callees are cached only links them. `max_power_w` is half of the limiter. A second process compiles it for the types of
the first plan's arguments, while this one plans up to the limiter, and then compiles the kernels that change the state.
Both write to the same cache, entry by entry, so a kernel that both need is compiled twice at worst. If the second
process fails, this one compiles its half itself.
"""

import pickle
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numba

from optodrive.core.child_process import die_with_parent
from optodrive.core.kernels import CACHED, is_cached
from optodrive.core.types.plans import BudgetState
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.cap_checks import PixelStartState, max_power_w
from optodrive.planning.limiter.pulse_application import apply_pulses, commit, compute_start_state
from optodrive.planning.limiter.slow_nodes import PulseRequest
from optodrive.planning.limiter.workspace import open_workspace

REQUEST = PulseRequest(0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
BEFORE = PixelStartState(0.0, 0.0, 0.0, 0.0)


class ColdStart:
    """The second process of one that plans for the first time."""

    def __init__(self) -> None:
        self._is_first = True
        self._process: subprocess.Popen[bytes] | None = None

    def begin(self, budget: Budget, state: BudgetState) -> None:
        """Start the second process unless the limiter is compiled already."""
        if not self._is_first:
            return
        self._is_first = False
        if CACHED and not is_cached(apply_pulses):
            command = [sys.executable, "-P", "-m", __name__]
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL)
            assert self._process.stdin is not None  # noqa: S101
            with suppress(BrokenPipeError), self._process.stdin as pipe:
                pipe.write(pickle.dumps(_list_types(budget, open_workspace(state, 1), REQUEST, BEFORE)))

    def finish(self, budget: Budget, state: BudgetState) -> None:
        """Compile this process's half and wait for the other."""
        process, self._process = self._process, None
        if process is not None:
            workspace = open_workspace(state, 1)
            _compile(compute_start_state, _list_types(budget, workspace, REQUEST))
            _compile(commit, _list_types(budget, workspace, REQUEST, 0.0, BEFORE))
            process.wait()


COLD_START = ColdStart()
"""That of this process."""


_find_type: Callable[[object], Any] = numba.typeof  # numba has no types


def _list_types(*arguments: object) -> tuple[Any, ...]:
    """Return numba's types of a kernel's arguments. They alone tell read-only arrays from others after pickling."""
    return tuple(map(_find_type, arguments))


def _compile(kernel: Any, types: tuple[Any, ...]) -> None:
    kernel.compile(types)


def main() -> None:
    """Compile the second half for the pickled types on standard input, which the process that plans has sent."""
    die_with_parent()
    _compile(max_power_w, pickle.load(sys.stdin.buffer))  # noqa: S301


if __name__ == "__main__":
    main()
