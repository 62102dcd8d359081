"""Main function of the planner process."""

import signal
from contextlib import ExitStack
from pathlib import Path

from optodrive.core.child_process import BeatWriter, SupervisorGoneError
from optodrive.core.clock import MonotonicClock
from optodrive.core.processes import PLANNING, set_realtime_priority
from optodrive.daemon.engine.engine import Engine
from optodrive.daemon.engine.planner_server import PlannerServer
from optodrive.daemon.engine.session_recording import start_session_recorder
from optodrive.daemon.engine.thermal_memory import ThermalMemory
from optodrive.daemon.log import open_daemon_log
from optodrive.daemon.runtime_folder import RuntimeFolder
from optodrive.link.board_setup import build_scales
from optodrive.link.service.remote_session import RemoteSession
from optodrive.planning.display_model import DisplayModel


def run_planner(
    display: DisplayModel,
    folder: RuntimeFolder,
    beat: BeatWriter,
    session_path: Path | None,
    memory: ThermalMemory,
) -> None:
    """Plan and hand over until SIGTERM or the end of the supervisor.

    display: warm, see `warm_up`; session_path: new HDF5 file for a recording of every plan, instead of the configured
    one; memory: shared with earlier and later planner processes. Raise InputError if the recording cannot be started.
    """
    ending: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: ending.append(number))
    clock = MonotonicClock()
    with ExitStack() as exit_stack:
        log = open_daemon_log()
        exit_stack.callback(log.close)
        session = RemoteSession(build_scales(display.config), folder.link_socket, clock)
        engine = Engine(display, session, clock, memory)
        engine.on_warning = log.warn
        recorder = start_session_recorder(engine, session_path, log)
        if recorder is not None:
            exit_stack.callback(recorder.close)
        exit_stack.callback(engine.close)
        server = PlannerServer(engine, folder.planner_socket, clock)
        exit_stack.callback(server.close)

        engine.on_loop, engine.on_beat = server.publish_state, beat.beat
        engine.message_loop.watch(beat, beat.receive)
        beat.report_ready()
        set_realtime_priority(PLANNING)
        try:
            engine.run(lambda: bool(ending))
        except SupervisorGoneError:
            return
