"""Process that has loaded everything and forks `optodrive` commands and simulated boards in milliseconds.

A fresh interpreter spends 1.5 s of processor time on imports and kernels before `optodrive serve` does anything; a
fork runs the same program from there on. Started with a socket of packets: each asks for one process, see `serve`.
"""

import atexit
import json
import os
import resource
import select
import signal
import socket
import sys
import threading
import traceback
from pathlib import Path

REQUEST_MAX_BYTES = 200_000
RLIMITS = (resource.RLIMIT_NOFILE, resource.RLIMIT_FSIZE, resource.RLIMIT_AS, resource.RLIMIT_CORE)


def load():
    """Import the modules that a daemon, a command or a board imports, and load the compiled kernels."""
    import optodrive.cli.main
    import optodrive.daemon.engine.planner_server
    import optodrive.daemon.preview.process
    import optodrive.daemon.server.web_process
    import optodrive.daemon.supervisor.daemon
    import optodrive.link.simulator.board_process  # noqa: F401
    from optodrive.device.config_file import load_config
    from optodrive.planning.display_model import DisplayModel
    from optodrive.planning.pipeline import warm_up

    warm_up(DisplayModel.from_config(load_config("display-437")))


def run_optodrive():
    from optodrive.cli.main import main

    main()


def run_board():
    from optodrive.link.simulator import board_process

    sys.exit(board_process.main())


def run_short_indicator_board():
    import short_indicator_board

    sys.exit(short_indicator_board.main())


def run_to_end(program):
    """Run a program as an interpreter does, and end at once: to free every object would take longer than to start."""
    status = 0
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
        status = program()
    except SystemExit as end:
        status = end.code
    except KeyboardInterrupt:  # earlier than the program can handle it
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.raise_signal(signal.SIGINT)
    except BaseException:
        traceback.print_exc()
        status = 1
    if not isinstance(status, int | None):
        print(status, file=sys.stderr)
        status = 1
    threading._shutdown()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    os._exit(status or 0)


PROGRAMS = {"optodrive": run_optodrive, "board": run_board, "short_indicator_board": run_short_indicator_board}


def serve(control):
    """Fork a process per request until the socket is closed. Return the program to run in each fork, None here.

    A request is a JSON object (program, arguments, folder, environment, limits) with the descriptors 0, 1 and 2 of the
    new process and a stream socket, which receives the process's id and, at its end, its status of waitpid.
    """
    poll, ends = select.poll(), {}
    poll.register(control, select.POLLIN)
    while True:
        for descriptor, _ in poll.poll():
            if descriptor != control.fileno():
                pid, status = ends.pop(descriptor)
                poll.unregister(descriptor)
                os.close(descriptor)
                os.write(status, f"{os.waitpid(pid, 0)[1]}\n".encode())
                os.close(status)
                continue
            packet, descriptors, _, _ = socket.recv_fds(control, REQUEST_MAX_BYTES, 4)
            if not packet:
                for pid, _ in ends.values():  # of tests that were killed: nobody else would end a daemon or a board
                    os.kill(pid, signal.SIGTERM)
                return None
            request, (*standard, status) = json.loads(packet), descriptors
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # for the fork, until it no longer ignores it
            pid = os.fork()
            if pid == 0:
                control.close()
                for other, (_, its_status) in ends.items():
                    os.close(other)
                    os.close(its_status)
                os.close(status)
                become(request, standard)
                signal.signal(signal.SIGINT, signal.default_int_handler)
                return PROGRAMS[request["program"]]
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
            for number in standard:
                os.close(number)
            os.write(status, f"{pid}\n".encode())
            exit_descriptor = os.pidfd_open(pid)
            ends[exit_descriptor] = pid, status
            poll.register(exit_descriptor, select.POLLIN)


def become(request, standard):
    """Give this fork the descriptors, arguments, environment, folder and limits of the requested process."""
    from optodrive.planning import heat_record

    for number, descriptor in enumerate(standard):
        os.dup2(descriptor, number)
        os.close(descriptor)
    sys.stdin, sys.stdout, sys.stderr = (
        os.fdopen(number, mode, encoding="utf-8", errors=errors, closefd=False, buffering=1 if is_by_line else -1)
        for number, mode, errors, is_by_line in (
            (0, "r", "strict", False),
            (1, "w", "strict", os.isatty(1)),
            (2, "w", "backslashreplace", True),
        )
    )
    sys.__stdin__, sys.__stdout__, sys.__stderr__ = sys.stdin, sys.stdout, sys.stderr
    sys.argv = [request["program"], *request["arguments"]]
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["folder"])
    if "HEAT_FOLDER" in os.environ:  # in place of that which all users share
        heat_record.FOLDER = Path(os.environ["HEAT_FOLDER"])
    for limit, values in request["limits"]:
        resource.setrlimit(limit, values)
    Path("/proc/self/comm").write_text(request["program"][:15])


if __name__ == "__main__":
    control = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the tests, whose end ends this process
    load()
    import gc

    gc.collect()
    gc.freeze()
    program = serve(control)
    if program is not None:
        run_to_end(program)
