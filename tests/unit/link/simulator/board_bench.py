"""Test bench of a simulated board: explicit frames and time, and access to its log."""

from dataclasses import replace

from optodrive.link.protocol import messages as m
from optodrive.link.protocol.framing import Frame, FrameDecoder, encode_frame
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.board_limits import DEFAULT_LIMITS, BoardSettings

CENTRE = 32768
LEASE_STEP_US = 20_000


class Bench:
    """A board with its host side. limits: fields that differ from the defaults; settings: of the board."""

    def __init__(self, limits=None, **settings):
        self.log = []
        own = replace(DEFAULT_LIMITS, **(limits or {}))
        self.core = BoardCore(BoardSettings(limits=own, **settings), self.log.append, seed=1)
        self.now_us = 0
        self.session = 0
        self.seq = 0
        self.index = 0
        self.host_bytes = []
        self._decoder = FrameDecoder()

    # --- bytes ---

    def raw(self, data):
        """Pass bytes to the board and return its answers."""
        self.host_bytes.append(data)
        self.core.receive(data, self.now_us)
        return self.take()

    def take(self):
        return [m.parse_message(frame.type, frame.body) for frame in self._decoder.feed(self.core.bytes_to_send())]

    def frame(self, message, seq=None, session=None):
        if seq is None:
            seq = self.seq if message.SEQUENCED else 0
            self.seq = (self.seq + message.SEQUENCED) % 256
        session = self.session if session is None else session
        return encode_frame(Frame(message.TYPE, seq, session, message.encode_body()))

    def send(self, *messages):
        """Pass messages in one batch and return the answers."""
        return self.raw(b"".join([self.frame(message) for message in messages]))

    # --- time ---

    def wait(self, duration_us, lease=True):
        """Advance the time and renew the lease."""
        until_us, answers = self.now_us + duration_us, []
        while self.now_us < until_us:
            self.now_us = min(until_us, self.now_us + LEASE_STEP_US)
            self.core.advance(self.now_us)
            answers += self.take()
            if lease:
                answers += self.send(m.Lease(100))
        return answers

    # --- session, arming, jobs ---

    def hello(self, nonce=42, major=m.MAJOR):
        """Begin a session and return the board's reply."""
        self.seq = self.index = 0
        (reply,) = [x for x in self.send(m.Hello(major, 0, nonce)) if isinstance(x, m.HelloReply)]
        self.session = reply.session
        return reply

    def challenge(self):
        return next(x for x in self.send(m.ArmReq(99)) if isinstance(x, m.ArmChallenge))

    def arm(self):
        challenge = self.challenge()
        self.send(m.ArmConfirm(challenge.host_nonce, challenge.board_nonce))
        self.wait(2_000_000)
        assert self.state == "ARMED", self.state
        return self

    def ready(self):
        self.hello()
        return self.arm()

    def data(self, *points):
        """Build a DATA message of points (x, y, dark_us, on_us, duty), numbered after the last one."""
        first, self.index = self.index, self.index + len(points)
        return m.Data(first, b"".join(m.POINT.pack(*point) for point in points))

    def play(self, *points, end=True):
        """Send points, an immediate START, and END."""
        first = self.index
        pieces = [self.data(*points[at : at + m.POINTS_MAX]) for at in range(0, len(points), m.POINTS_MAX)]
        return self.send(*pieces, m.Start(1, first, 0, 1), *([m.End(1, self.index)] if end else []))

    # --- observations ---

    @property
    def state(self):
        return self.core.state

    @property
    def fault(self):
        return self.core.fault

    def of(self, event):
        return [entry for entry in self.log if entry["event"] == event]

    @property
    def edges(self):
        """(time, on) of each gate edge."""
        return [(entry["t_us"], entry["on"]) for entry in self.of("gate")]

    @property
    def pulses(self):
        """(index, gate on, gate off) of each pulse, from the log."""
        return [(entry["index"], entry["on_us"], entry["off_us"]) for entry in self.of("pulse")]

    def condition(self):
        """Return the state that invalid frames must not change."""
        machine = self.core.machine
        queue = machine.queue
        return (
            machine.state,
            machine.gate,
            len(queue),
            queue.first_index,
            queue.job,
            machine._current_point,
            queue.next_index,
            machine.lease_until_us,
        )

    @property
    def limits(self):
        """Limits in force."""
        return self.core.machine.limits

    def bad_frames(self):
        """Return the counts of CRC and format errors."""
        counted = self.core._link.decoder.counters
        return [counted.crc_errors, counted.format_errors]

    def status(self):
        (status,) = [x for x in self.send(m.Get()) if isinstance(x, m.Status)]
        return status


def here(on_us, dark_us=0, duty=65535, x=CENTRE, y=CENTRE):
    """Return a point, by default at the centre."""
    return x, y, dark_us, on_us, duty


def naks(answers):
    return [m.NAK_REASONS[x.reason] for x in answers if isinstance(x, m.Nak)]
