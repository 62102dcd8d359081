"""A supervisor over children of a few lines, each of which serves, hangs, dies, fails or is deaf, start by start.

arguments: FOLDER NAME=BEHAVIOUR[,BEHAVIOUR…]…, one behaviour per start of the child, of which the last one repeats
$MUTANT: one of MUTANTS, a check that the supervisor then lacks; $END_GRACE_S: in place of the supervisor's own
"""

import json
import os
import signal
import socket
import sys
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

from optodrive.core import child_process
from optodrive.core.child_process import BeatWriter, fork_with_beat
from optodrive.core.clock import MonotonicClock
from optodrive.core.errors import InputError
from optodrive.core.ipc import IpcError, Message, MessageSocket
from optodrive.daemon.log import DaemonLog, Notifier
from optodrive.daemon.supervisor import supervisor
from optodrive.daemon.supervisor.child import Child
from optodrive.daemon.supervisor.supervisor import LinkView, Supervisor

STATUS = {"connected": True, "port": "tty", "board": {"state": "DISARMED"}}

MUTANTS = {
    "no STOP before the end": lambda: setattr(LinkView, "stop_and_wait", lambda self, timeout_s: None),
    "no death of a hung child": lambda: setattr(Child, "find_hang", lambda self, now_s: None),
    "no death with the supervisor": lambda: setattr(child_process, "PR_SET_PDEATHSIG", 0),
}


def behave(behaviour, name, folder, beat):
    """Live the life of a child. One that dies or hangs does so once the daemon serves: before, that would end it."""
    listener = None
    if behaviour == "fail":
        raise InputError("capture", "x.jsonl", "a new file")
    ends = []
    signal.signal(signal.SIGTERM, signal.SIG_IGN if behaviour == "deaf" else lambda *_: ends.append(True))
    if name == "link":
        path = folder / "link.sock"
        path.unlink(missing_ok=True)
        listener = socket.socket(socket.AF_UNIX)
        listener.bind(str(path))
        listener.listen()
        listener.setblocking(False)
    note(folder, f"{name} starts", descriptors=len(list(Path("/proc/self/fd").iterdir())) - 1)
    beat.report_ready()
    clients = []
    while True:
        is_last, is_served = bool(ends), (folder / "serving").exists()
        if is_served and behaviour == "die":
            os._exit(3)
        if is_served and behaviour == "hang":
            note(folder, f"{name} hangs")
            while True:
                time.sleep(1000)
        beat.beat()
        for fields in beat.receive():
            note(folder, f"{name} receives", **fields)
        clients = serve_link(listener, clients, folder)
        if is_last:
            note(folder, f"{name} ends")
            return
        time.sleep(0.02)


def serve_link(listener, clients, folder):
    if listener is None:
        return []
    with suppress(BlockingIOError):
        clients.append(MessageSocket(listener.accept()[0]))
    alive = []
    for client in clients:
        try:
            for message in client.receive():
                if message.kind == "stop":
                    note(folder, "link stops")
                    client.send(Message("result", {"id": message.fields["id"], "error": None}))
            client.send(Message("status", STATUS))
            alive.append(client)
        except IpcError:
            pass
    return alive


def note(folder, event, **fields):
    with (folder / "notes.jsonl").open("a") as file:
        file.write(json.dumps({"event": event, "pid": os.getpid(), "s": time.monotonic(), **fields}) + "\n")


def main():
    MUTANTS.get(os.environ.get("MUTANT"), lambda: None)()
    supervisor.END_GRACE_S = float(os.environ["END_GRACE_S"])
    folder = Path(sys.argv[1])
    clock = MonotonicClock()
    children = {}
    for argument in sys.argv[2:]:
        name, _, listed = argument.partition("=")
        children[name] = Child(name, partial(start, name, listed.split(","), folder), clock)
    notifier = Notifier(clock)
    daemon = Supervisor(children.pop("link"), LinkView(folder / "link.sock", clock), notifier, DaemonLog(), clock)
    daemon.install_signal_handlers()
    try:
        daemon.start_link()
        web = children.pop("web")
        if daemon.start_others(list(children.values()), web):
            note(folder, "serves")
            (folder / "serving").touch()
            daemon.serve()
    finally:
        daemon.close()
        note(folder, "ended")


def start(name, behaviours, folder, channel, number):
    behaviour = behaviours[min(number, len(behaviours)) - 1]

    def live(beat: BeatWriter):
        behave(behaviour, name, folder, beat)

    return fork_with_beat(live, f"tiny-{name}", channel.fileno())


if __name__ == "__main__":
    main()
