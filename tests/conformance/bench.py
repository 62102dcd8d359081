"""Test bench of the scenarios: boards of a kind, and a minimal host, in real or in virtual time."""

from pathlib import Path

from wire_format import DATA_POINTS_MAX, HOST, SEQUENCED, MessageReader, body_of, frame

CENTRE = 32768
WINDOW = 8
WITH_THE_END = 65_535
"""A watermark that no queue reaches, so that the job begins at its END independently of the speed of line and board."""
LEASE_EVERY_S = 0.05
PATIENT = dict(lease_ms=60_000)
"""A lease that tolerates a host that is scheduled late."""
BRIGHT = dict(max_on_us=65_000, spot_uj=4_000_000_000, spot_leak_uw=4_000_000_000, rest_us=0, **PATIENT)
"""Limits that permit long pulses."""
SHINE_S = 60.0


class Host:
    """A host on a board's port that renews the lease while it waits, unless disabled."""

    def __init__(self, board):
        self.board, self.clock = board, board.clock
        self.port = board.open()
        self.written = []
        self.session = self.seq = self.index = 0
        self.received = []
        self._reader = MessageReader()
        self._leased_s = 0.0

    # --- messages ---

    def raw(self, data):
        """Write bytes."""
        self.written.append(data)
        self.port.write(data)

    def frame(self, name, seq=None, session=None, **fields):
        """Encode a message. A sequenced one gets the next sequence number."""
        if seq is None:
            seq = self.seq if name in SEQUENCED else 0
            self.seq = (self.seq + (name in SEQUENCED)) % 256
        session = self.session if session is None else session
        return frame(HOST[name][0], seq, session, body_of(name, **fields))

    def send(self, name, **fields):
        """Send a message without waiting."""
        self.raw(self.frame(name, **fields))

    def receive(self):
        """Read the messages that have arrived."""
        self.received += self._reader.take(self.port.read())

    def of(self, name):
        """Return the received messages of a kind."""
        return [message for message in self.received if message.name == name]

    def wait(self, condition, what, lease=True):
        """Read messages until condition() is true."""
        until_s = self.clock.now_s() + self.board.patience_s
        while not condition():
            assert self.clock.now_s() < until_s, f"timed out waiting for {what}; log {self.board.events()[-8:]}"
            if lease:
                self.lease()
            self.receive()

    def lease(self):
        """Renew the lease, at a limited rate."""
        if self.session and self.clock.now_s() - self._leased_s > LEASE_EVERY_S:
            self._leased_s = self.clock.now_s()
            self.send("LEASE", ms=60_000)

    def pause(self, duration_s, lease=True):
        """Wait for a time."""
        until_s = self.clock.now_s() + duration_s
        self.wait(lambda: self.clock.now_s() >= until_s, "the time", lease)

    def wait_for_change(self, reason, count=1, lease=True):
        """Wait for the count-th change of state for a reason. Return its log entry."""
        self.wait(lambda: len(self.board.changes(reason)) >= count, f"{count} changes by {reason}", lease)
        return self.board.changes(reason)[count - 1]

    def request(self, data=b""):
        """Send bytes. Return the board's answers and its status after them."""
        before = len(self.received)
        self.raw(data)
        for _ in range(2):  # an ACK may follow its batch, so the answers are complete only at the second status
            count = len(self.of("STATUS"))
            self.send("GET")
            self.wait(lambda count=count: len(self.of("STATUS")) > count, "a status", lease=False)
        status = self.of("STATUS")[-1]
        return [m for m in self.received[before:] if m.name != "STATUS"], status

    def order(self, *frames):
        """Send frames in batches of the window size. Return the reasons of all NAKs."""
        answers = []
        for at in range(0, len(frames), WINDOW):
            self.lease()  # hundreds of frames may take longer than one lease
            answers.append(self.request(b"".join(frames[at : at + WINDOW]))[0])
        return [message.reason for messages in answers for message in messages if message.name == "NAK"]

    def send_checked(self, name, **fields):
        """Send one message. Return the reasons of its NAKs."""
        return self.order(self.frame(name, **fields))

    def status(self):
        """Request the board's status."""
        return self.request()[1]

    # --- session, arming, jobs ---

    def hello(self, major=1):
        """Begin a session and return the board's reply. Repeat HELLO, as a board may detect the open port late."""
        nonce = 0
        until_s = self.clock.now_s() + self.board.patience_s
        while self.clock.now_s() < until_s:
            self.session = self.seq = self.index = 0
            nonce += 1
            before = len(self.received)
            self.send("HELLO", major=major, minor=0, host_nonce=nonce)
            soon_s = self.clock.now_s() + 0.5
            while self.clock.now_s() < soon_s:
                self.receive()
                for message in self.received[before:]:
                    if message.name == "HELLO_REPLY" and message.host_nonce == nonce:
                        self.session = message.session
                        return message
        raise AssertionError("no answer to HELLO")

    def challenge(self, host_nonce=99):
        """Send ARM_REQ and return the challenge."""
        answers, _ = self.request(self.frame("ARM_REQ", host_nonce=host_nonce))
        (challenge,) = [message for message in answers if message.name == "ARM_CHALLENGE"]
        return challenge

    def arm(self):
        """Arm the board by the regular sequence."""
        count = self.board.states().count(("ARMED", "armed"))
        challenge = self.challenge()
        self.send("ARM_CONFIRM", host_nonce=challenge.host_nonce, board_nonce=challenge.board_nonce)
        self.wait(lambda: self.board.states().count(("ARMED", "armed")) > count, "ARMED")
        return self

    def data(self, *points):
        """Build a DATA frame of points (x, y, dark_us, on_us, duty), numbered after the last one."""
        first, self.index = self.index, self.index + len(points)
        return self.frame("DATA", first_index=first, points=points)

    def play(self, *points, end=True, start_tick=0, watermark=1):
        """Send points, START and END at once. Return the reasons of the NAKs."""
        first = self.index
        pieces = [points[at : at + DATA_POINTS_MAX] for at in range(0, len(points), DATA_POINTS_MAX)]
        frames = [self.data(*piece) for piece in pieces]
        frames.append(self.frame("START", job=1, first_index=first, start_tick=start_tick, watermark=watermark))
        if end:
            frames.append(self.frame("END", job=1, end_index=self.index))
        return self.order(*frames)

    def shine(self, duty=2000, seconds=SHINE_S):
        """Run a job with the gate on nearly continuously, without END. Return its number of points."""
        points = [here(60_000, duty=duty)] * int(seconds / 0.06)
        assert self.play(*points, end=False) == []
        self.wait(self.board.is_gate_on, "light")
        return len(points)

    def close(self):
        """Close the port."""
        self.port.close()


class Bench:
    """Creates and stops the boards and hosts of one scenario."""

    def __init__(self, kind, folder):
        self.kind = kind
        self._folder, self._clock = Path(folder), kind.make_clock()
        self._boards, self._hosts = [], []

    def board(self, *steps, **limits):
        """Start a board. steps: of its script, as tables."""
        self._boards.append(self.kind.start(self._folder, self._clock, len(self._boards), steps, limits))
        return self._boards[-1]

    def host(self, board):
        """Open a host on the board's port."""
        self._hosts.append(Host(board))
        return self._hosts[-1]

    def greeted(self, *steps, **limits):
        """Return a host in session with a new board."""
        host = self.host(self.board(*steps, **limits))
        host.hello()
        return host

    def ready(self, *steps, **limits):
        """Return a host that has armed a new board."""
        return self.greeted(*steps, **limits).arm()

    def finish(self, audit):
        """Close all hosts and boards. Pass each board to audit."""
        try:
            for host in self._hosts:
                host.close()
        finally:
            for board in self._boards:
                board.end()
        for board in self._boards:
            audit(board)


def set_input(name, value):
    """Return the step that sets an input."""
    return {"set": name, "value": value}


def act(action):
    """Return the step that resets a board or breaks a part of it."""
    return {"do": action}


def here(on_us, dark_us=0, duty=65535, x=CENTRE, y=CENTRE):
    """Return a point, by default at the centre."""
    return x, y, dark_us, on_us, duty
