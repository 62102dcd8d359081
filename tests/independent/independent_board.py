"""The board in JavaScript, written from PROTOCOL.md alone, as a core of the conformance suite in virtual time."""

import json
import subprocess
from dataclasses import asdict

from javascript import HERE, javascript
from virtual_board import EmulatedBoard, VirtualKind

from optodrive.link.simulator.measured_mirrors import MIRROR_FAULTS


class IndependentCore:
    """A process of board_process.mjs. guard: the one that it violates, '' for none."""

    FAULTS = ("stop_loop", "stop_tick", "late_tick", "stick_gate", *MIRROR_FAULTS, "repair")

    def __init__(self, settings, sink, seed=0, guard=""):
        self._sink = sink
        self.gate, self.state, self.gate_edges = False, "BOOT", []
        self._output = b""
        self._process = subprocess.Popen(
            javascript(HERE / "board_process.mjs", *[guard] * bool(guard)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        flat = asdict(settings)
        self._request(flat.pop("limits") | flat)

    def _request(self, request):
        self._process.stdin.write(json.dumps(request).encode() + b"\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        self._output += bytes.fromhex(answer["data"])
        self.gate_edges += map(tuple, answer["edges"])
        for entry in answer["log"]:
            self.gate = entry.get("on", self.gate)
            self.state = entry.get("state", self.state)
            self._sink(entry)

    def advance(self, now_us):
        """Advance to a time."""
        self._request({"do": "advance", "at": now_us})

    def receive(self, data, now_us):
        """Receive bytes from the host."""
        self._request({"do": "receive", "at": now_us, "data": data.hex()})

    def bytes_to_send(self):
        """Return the bytes for the host."""
        data, self._output = self._output, b""
        return data

    def set_input(self, name, value, now_us):
        """Set an input."""
        self._request({"do": "input", "at": now_us, "name": name, "value": value})

    def receive_trigger(self, now_us):
        """Receive an edge at the trigger input."""
        self._request({"do": "trigger", "at": now_us})

    def reset(self, now_us):
        """Reset the board."""
        self._request({"do": "reset", "at": now_us})

    def inject_fault(self, fault):
        """Break a part of the board."""
        self._request({"do": "inject", "fault": fault})

    def on_link_lost(self, now_us):
        """Close the port."""
        self._request({"do": "close", "at": now_us})

    def close(self):
        """End the process."""
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


def independent_kind(guard=""):
    """Return the kind of this board. guard: the one that it violates, '' for none."""

    def make(settings, sink, seed):
        return IndependentCore(settings, sink, seed, guard)

    return VirtualKind("independent", make, make_board=EmulatedBoard)
