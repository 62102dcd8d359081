"""Emulated network DACs as processes on loopback, in real time, with logs in their own clocks.

Each has a loopback address of its own, so that devices with fixed ports run side by side.
"""

import ctypes
import json
import os
import random
import selectors
import signal
import socket
import time
from contextlib import suppress

import numpy as np

from dac.emulated_ether_dream import CLOCK_HZ, Connection, EtherDreamCore
from dac.emulated_idn import IdnCore
from optodrive.core.processes import LIGHT, set_realtime_priority

ETHER_DREAM_PORT, IDN_PORT = 7765, 7255
REST_S = 2.0
"""How much longer a device runs in its own time than in that of the test, which hears nothing more of it."""


def draw_address():
    return "127." + ".".join(str(random.randint(1, 250)) for _ in range(3))


def _end_with_parent():
    """Ask the kernel for the end of this process with the thread that forked it."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)


class DeviceProcess:
    """One device, forked from the loaded test process.

    serve: function of (address, port of broadcasts, wait) that runs it and returns its log
    """

    def __init__(self, serve, folder, broadcast_port=0, **device):
        self.address, self.path = draw_address(), folder / f"device-{random.getrandbits(64):x}.npz"
        ready, done = os.pipe()
        self.pid = os.fork()
        if not self.pid:
            os.close(ready)
            _end_with_parent()
            set_realtime_priority(LIGHT)  # a device is no process that waits for others
            try:
                stopped = []
                signal.signal(signal.SIGTERM, lambda *_: stopped.append(True))
                marks_s = []
                signal.signal(signal.SIGUSR1, lambda *_: marks_s.append(time.monotonic()))
                log = serve(self.address, broadcast_port, lambda: os.write(done, b"."), stopped, **device)
                log["marks_s"] = np.array(marks_s) - log["zero_s"]
                np.savez(self.path, **log)
            finally:
                os._exit(0)
        os.close(done)
        assert os.read(ready, 1), "the device did not start"
        os.close(ready)

    def mark(self):
        """Note a moment in the device's log, by its own clock, as `marks_s`."""
        os.kill(self.pid, signal.SIGUSR1)

    def finish(self):
        """End the device and return its log."""
        os.kill(self.pid, signal.SIGTERM)
        os.waitpid(self.pid, 0)
        with np.load(self.path) as log:
            return dict(log)


def serve_ether_dream(address, broadcast_port, started, stopped, **device):
    """Serve an Ether Dream. Its log: table, end_s, arrivals_s of data, zero_s of its clock on the host's."""
    core, zero_s = EtherDreamCore(**device), time.monotonic()
    arrivals_s, connections = [], {}
    with selectors.DefaultSelector() as selector, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio:
        radio.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        radio.bind((address, 0))
        listener = socket.create_server((address, ETHER_DREAM_PORT))
        selector.register(listener, selectors.EVENT_READ)
        started()
        while not stopped:
            events = selector.select(0.01)
            now_s = time.monotonic() - zero_s
            core.advance(int(now_s * CLOCK_HZ))
            if broadcast_port and not events:  # more often than once per second, as the device does
                radio.sendto(core.broadcast(), ("127.255.255.255", broadcast_port))
            for key, _ in events:
                if key.fileobj is listener:
                    stream, _ = listener.accept()
                    connections[stream] = Connection(core)
                    stream.sendall(connections[stream].hello())
                    selector.register(stream, selectors.EVENT_READ)
                    continue
                stream = key.fileobj
                data = b""
                with suppress(OSError):
                    data = stream.recv(65_536)
                if data:
                    now_s = time.monotonic() - zero_s
                    arrivals_s.append(now_s)
                    answers = connections[stream].receive(data, int(now_s * CLOCK_HZ))
                    with suppress(OSError):
                        stream.sendall(answers)
                if not data or connections[stream].closed:
                    selector.unregister(stream)
                    stream.close()
        core.advance(int((time.monotonic() - zero_s + REST_S) * CLOCK_HZ))
    return {
        "table": core.log.table(core.now_s),
        "end_s": core.now_s,
        "arrivals_s": np.array(arrivals_s),
        "zero_s": zero_s,
        "played": core.played,
        "starved": core.starved,
        "counters": json.dumps({"flags": core.playback_flags}),
    }


def serve_idn(address, broadcast_port, started, stopped, **device):
    """Serve an IDN device, which states itself when it is asked only. Its log is as an Ether Dream's."""
    core, zero_s = IdnCore(**device), time.monotonic()
    arrivals_s = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio:
        radio.bind((address, IDN_PORT))
        radio.settimeout(0.01)
        started()
        while not stopped:
            with suppress(TimeoutError):
                data, source = radio.recvfrom(65_536)
                now_s = time.monotonic() - zero_s
                if data[0] in (0x40, 0x41):
                    arrivals_s.append(now_s)
                for answer in core.receive(data, now_s, source):
                    radio.sendto(answer, source)
        core.advance(time.monotonic() - zero_s + REST_S)
    return {
        "table": core.log.table(core.now_s),
        "end_s": core.now_s,
        "arrivals_s": np.array(arrivals_s),
        "zero_s": zero_s,
        "played": core.log.count,
        "dropped": core.dropped,
        "speeds": np.array(core.speeds),
    }


class HostProcess:
    """A host that is forked from the loaded test process and calls a function."""

    def __init__(self, call):
        self.report, tell = os.pipe()
        self.pid = os.fork()
        if not self.pid:
            os.close(self.report)
            _end_with_parent()
            text = ""
            try:
                call()
            except BaseException as error:
                text = f"{type(error).__name__}: {error}"
            finally:
                with suppress(OSError):
                    os.write(tell, text.encode())
                os._exit(1 if text else 0)
        os.close(tell)

    def kill(self, number=signal.SIGKILL):
        os.kill(self.pid, number)

    def wait(self):
        """Wait for its end. Return what it raised, '' for nothing, None if it was killed."""
        text = b""
        while data := os.read(self.report, 4096):
            text += data
        os.close(self.report)
        _, status = os.waitpid(self.pid, 0)
        return None if os.WIFSIGNALED(status) else text.decode()
