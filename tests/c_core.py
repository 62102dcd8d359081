"""The C core in this process, with the interface of `BoardCore`."""

import ctypes
import random
import subprocess
from pathlib import Path

from firmware_ports import require
from optodrive.link.protocol import messages as m
from optodrive.link.simulator.guards import INTERFACES, BoardSettings
from optodrive.link.simulator.measured_mirrors import MIRROR_FAULTS

FIRMWARE = Path(__file__).parents[1] / "firmware_protocol"
SHIM = Path(__file__).with_name("firmware") / "shim.c"
INPUT_BITS = {name: 1 << k for k, name in enumerate(m.INPUTS)}
SHIM_VALUES = (
    "state",
    "fault",
    "gate",
    "gate_output",
    "indicator",
    "relay",
    "fed_us",
    "x",
    "y",
    "crc",
    "format",
    "fingerprint",
)
TRACE_KINDS = ("gate", "state", "fault", "pulse", "rx_error")
OUT_MAX = 1 << 20


class Trace(ctypes.Structure):
    _fields_ = (
        ("at_us", ctypes.c_uint64),
        ("kind", ctypes.c_int),
        ("on", ctypes.c_bool),
        ("is_point", ctypes.c_bool),
        ("state", ctypes.c_uint8),
        ("before", ctypes.c_uint8),
        ("reason", ctypes.c_uint8),
        ("fault", ctypes.c_uint8),
        ("x", ctypes.c_uint16),
        ("y", ctypes.c_uint16),
        ("duty", ctypes.c_uint16),
        ("index", ctypes.c_uint32),
        ("on_us", ctypes.c_uint64),
        ("off_us", ctypes.c_uint64),
    )

    def entry(self):
        """Return the entry in the format of the simulated board's log."""
        kind = TRACE_KINDS[self.kind]
        done = "" if self.on else " done"
        why = f"point {self.index}{done}" if self.is_point else m.EVENT_REASONS[self.reason]
        more = {
            "gate": {"on": self.on, "reason": why},
            "state": {
                "state": m.STATES[self.state],
                "before": m.STATES[self.before],
                "reason": m.EVENT_REASONS[self.reason],
            },
            "fault": {"fault": m.FAULTS[self.fault]},
            "pulse": {name: getattr(self, name) for name in ("index", "x", "y", "duty", "on_us", "off_us")},
            "rx_error": {"bad_frames": self.index},
        }[kind]
        return {"t_us": self.at_us, "event": kind, **more}


class Edge(ctypes.Structure):
    _fields_ = (("at_us", ctypes.c_uint64), ("on", ctypes.c_uint32), ("duty", ctypes.c_uint32))


def build_library(folder, mutant=0, *defines):
    """Build the core and the shim as a shared library outside the source tree.

    defines: non-default sizes
    """
    require("gcc")
    library = folder / f"core-{mutant}{''.join(defines)}.so"
    sources = [*sorted((FIRMWARE / "core").glob("*.c")), SHIM]
    flags = [
        "-std=c11",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-O0" if mutant else "-O1",
        "-shared",
        "-fPIC",
    ]  # a mutant ends soon
    command = [
        "gcc",
        *flags,
        f"-DMUTANT={mutant}",
        *(f"-D{define}" for define in defines),
        f"-I{FIRMWARE / 'core'}",
        *sources,
        "-o",
        library,
    ]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return load(library)


def load(path):
    library = ctypes.CDLL(str(path))
    handle, u64, u32, size = ctypes.c_void_p, ctypes.c_uint64, ctypes.c_uint32, ctypes.c_size_t
    signatures = {
        "shim_new": ([ctypes.c_char_p, ctypes.c_char_p, *[u32] * 7], handle),
        "shim_interrupt": ([handle, u32], None),
        "shim_free": ([handle], None),
        "shim_entropy": ([handle, ctypes.POINTER(u32), size], None),
        "shim_init": ([handle, u32, u64], None),
        "shim_tick": ([handle, u64], None),
        "shim_run": ([handle, u64], None),
        "shim_loop": ([handle, u64], None),
        "shim_receive": ([handle, ctypes.c_char_p, size], None),
        "shim_link_lost": ([handle], None),
        "shim_set_inputs": ([handle, u32], None),
        "shim_trigger": ([handle, u64], None),
        "shim_set_head": ([handle, u32], None),
        "shim_fault_mirror": ([handle, u32], None),
        "shim_stick": ([handle, u32, u32], None),
        "shim_take_output": ([handle, ctypes.c_char_p], size),
        "shim_traces": ([handle, ctypes.POINTER(size)], ctypes.POINTER(Trace)),
        "shim_edges": ([handle, ctypes.POINTER(size)], ctypes.POINTER(Edge)),
        "shim_limits": ([handle, ctypes.c_char_p], None),
        "shim_get": ([handle, u32], u64),
        "frame_encode": (
            [ctypes.c_char_p, ctypes.c_uint8, ctypes.c_uint8, ctypes.c_uint16, ctypes.c_char_p, size],
            size,
        ),
    }
    for name, (arguments, result) in signatures.items():
        function = getattr(library, name)
        function.argtypes, function.restype = arguments, result
    return library


class CBoard:
    """A C core with punctual ticks.

    sink: receives each log event, as from the simulated board
    """

    def __init__(self, library, settings=None, sink=None, entropy=None):
        settings = settings or BoardSettings()
        self._library = library
        self._sink = sink or (lambda entry: None)
        self._handle = library.shim_new(
            settings.limits.encode_body(),
            bytes.fromhex(settings.uid),
            settings.cell_codes,
            settings.queue_points,
            settings.cells,
            settings.window_pulses,
            settings.key_edge,
            INTERFACES.index(settings.interface),
            settings.feedback_codes,
        )
        source = random.Random(1)
        values = entropy or [source.getrandbits(32) for _ in range(256)]
        library.shim_entropy(self._handle, (ctypes.c_uint32 * len(values))(*values), len(values))
        self.inputs = {"interlock": True, "key": True, "estop": False}
        self._triggers = 0
        self._out = ctypes.create_string_buffer(OUT_MAX)
        library.shim_init(self._handle, 0, 0)
        self._drain()

    def __del__(self):
        self._library.shim_free(self._handle)

    def _get(self, name):
        return self._library.shim_get(self._handle, SHIM_VALUES.index(name))

    def _drain(self):
        count = ctypes.c_size_t()
        traces = self._library.shim_traces(self._handle, ctypes.byref(count))
        for k in range(count.value):
            self._sink(traces[k].entry())

    state = property(lambda self: m.STATES[self._get("state")])
    fault = property(lambda self: m.FAULTS[self._get("fault")])
    gate = property(lambda self: bool(self._get("gate")))
    gate_output = property(lambda self: bool(self._get("gate_output")))
    indicator = property(lambda self: bool(self._get("indicator")))
    relay = property(lambda self: bool(self._get("relay")))
    fed_us = property(lambda self: self._get("fed_us"))
    fingerprint = property(lambda self: self._get("fingerprint"))
    bad_frames = property(lambda self: [self._get("crc"), self._get("format")])
    mirrors = property(lambda self: (self._get("x"), self._get("y")))

    @property
    def limits(self):
        body = ctypes.create_string_buffer(m.Limits.LAYOUT.size)
        self._library.shim_limits(self._handle, body)
        return m.Limits.parse(body.raw)

    @property
    def gate_edges(self):
        """(time, on) of each edge of the HAL's gate since power-up."""
        count = ctypes.c_size_t()
        edges = self._library.shim_edges(self._handle, ctypes.byref(count))
        return [(edges[k].at_us, bool(edges[k].on)) for k in range(count.value)]

    def advance(self, now_us, loop=True):
        """Run ticks every 100 µs up to now_us.

        loop: whether the main loop runs then
        """
        self._library.shim_run(self._handle, now_us)
        if loop:
            self.run_loop()
        self._drain()

    def tick(self, now_us):
        """Run one tick, possibly late."""
        self._library.shim_tick(self._handle, now_us)
        self._drain()

    def receive(self, data, now_us):
        self.advance(now_us)
        self.run_loop(data)

    def run_loop(self, data=b""):
        """Run one iteration of the main loop without a tick."""
        self._library.shim_receive(self._handle, data, len(data))
        self._drain()

    def loop(self, now_us):
        """Run one iteration of the main loop, possibly without the ticks before it."""
        self._library.shim_loop(self._handle, now_us)
        self._drain()

    def bytes_to_send(self):
        length = self._library.shim_take_output(self._handle, self._out)
        return ctypes.string_at(self._out, length)

    def set_input(self, name, value, now_us):
        """Change an input's level, which the next tick reads."""
        self.advance(now_us)
        self.inputs[name] = value
        self._sink({"t_us": now_us, "event": "input", "input": name, "value": value})
        bits = sum(INPUT_BITS[name] for name, on in self.inputs.items() if on)
        self._library.shim_set_inputs(self._handle, bits)

    def receive_trigger(self, now_us):
        """Receive a rising edge, which the next tick notices."""
        self.advance(now_us)
        self._triggers += 1
        self._sink({"t_us": now_us, "event": "trigger", "count": self._triggers})
        self._library.shim_trigger(self._handle, now_us)

    def set_head(self, status):
        """Set the status that the scan head returns, 0 for none."""
        self._library.shim_set_head(self._handle, status)

    def inject_fault(self, kind, now_us):
        """Break mirror x in one of MIRROR_FAULTS, or repair it: ''."""
        self.advance(now_us)
        self._library.shim_fault_mirror(self._handle, ("", *MIRROR_FAULTS).index(kind))

    def stick(self, stuck, on=False):
        """Freeze the gate's readback at `on`, or release it."""
        self._library.shim_stick(self._handle, stuck, on)

    def on_link_lost(self, now_us):
        self.advance(now_us)
        self._library.shim_link_lost(self._handle)
        self._drain()

    def reset(self, now_us, cause=1):
        self.advance(now_us)
        if self.gate:
            self._sink({"t_us": now_us, "event": "gate", "on": False, "reason": "reset"})
        self._triggers = 0
        self._library.shim_init(self._handle, cause, now_us)
        self.bytes_to_send()
        self._drain()


class SeededCBoard(CBoard):
    """A C core with the constructor of the simulated board."""

    def __init__(self, library, settings, sink, seed):
        entropy = random.Random(seed)
        super().__init__(library, settings, sink, [entropy.getrandbits(32) for _ in range(4096)])


class InterruptedCBoard(SeededCBoard):
    """A C core whose main loop a tick interrupts wherever it may."""

    def __init__(self, library, settings, sink, seed):
        super().__init__(library, settings, sink, seed)
        library.shim_interrupt(self._handle, 1)
