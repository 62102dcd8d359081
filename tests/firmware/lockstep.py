"""Lockstep comparison of the simulated board and the C core under equal bytes, inputs and times."""

import random

from c_core import CBoard
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.framing import Frame, FrameDecoder, encode_frame
from optodrive.link.simulator.board_core import BoardCore


class PythonEntropy:
    """The entropy of the C core for the simulated board's random numbers."""

    def __init__(self, values):
        self._values, self._at = values, 0

    def getrandbits(self, bits):
        value = self._values[self._at % len(self._values)]
        self._at += 1
        return value & ((1 << bits) - 1)

    def randrange(self, low, high):
        while (value := self.getrandbits(16)) == 0:
            pass
        return value


class Lockstep:
    """Both boards. Bytes, log and state are compared after each action."""

    def __init__(self, library, settings=None, entropy=None, seed=1):
        source = random.Random(seed)
        values = entropy or [source.getrandbits(32) for _ in range(256)]
        self.log, self.c_log = [], []
        self.python = BoardCore(settings, self.log.append)
        self.python._random = self.python.machine._random = PythonEntropy(values)
        self.c = CBoard(library, settings, self.c_log.append, values)
        self.now_us = 0
        self.received = []
        self.wire = []
        self._decoder = FrameDecoder()
        self.compare()

    def both(self, do):
        """Apply an action to both boards."""
        for board in (self.python, self.c):
            do(board)
        self.compare()

    def compare(self):
        answer = self.python.bytes_to_send()
        assert self.c.bytes_to_send() == answer
        assert self.c_log == self.log
        assert (self.c.state, self.c.fault, self.c.gate) == (self.python.state, self.python.fault, self.python.gate)
        self.received += [m.parse_message(frame.type, frame.body) for frame in self._decoder.feed(answer)]

    def raw(self, data):
        self.wire.append(data)
        self.both(lambda board: board.receive(data, self.now_us))

    def frame(self, message, ahead=0, session=None):
        """Encode a frame with the expected sequence number, or a later one."""
        link = self.python._link
        seq = (link.expected_seq + ahead) % 256 if message.SEQUENCED else 0
        return encode_frame(
            Frame(message.TYPE, seq, link.session if session is None else session, message.encode_body())
        )

    def send(self, *messages):
        for message in messages:
            self.raw(self.frame(message))

    def set_input(self, name, value):
        """Change an input of both boards. The C core reads it at once."""
        self.c.set_input(name, value, self.now_us)
        self.c.tick(self.now_us)
        self.python.set_input(name, value, self.now_us)
        self.compare()

    def wait(self, duration_us):
        self.now_us += duration_us
        self.both(lambda board: board.advance(self.now_us))


def arm(both, limits=None):
    """Arm both boards from any state, unless limits or a lost lease prevent it."""
    core = both.python
    for name, safe in (("interlock", True), ("key", True), ("estop", False)):
        if core.machine.inputs[name] != safe:
            both.set_input(name, safe)
    if both.python._settings.key_edge:
        both.set_input("key", False)
        both.set_input("key", True)
    both.send(m.Hello(1, 0, 5), m.ClearFault(), *([limits] if limits else []), m.ArmReq(6))
    both.send(m.ArmConfirm(6, core.machine._board_nonce or 0), m.Lease(60_000))
    for _ in range(30):
        both.wait(70_000)
        both.send(m.Lease(60_000))
