"""The link service with a simulated board in virtual time, and the clients that talk to it."""

import itertools
import zlib

from optodrive.core.clock import ManualClock
from optodrive.core.ipc import Message
from optodrive.device.config_file import load_config
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.service.link_service import LinkService
from optodrive.link.session.board_group import BoardGroup
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.virtual_run import MemoryLink

CONFIG = load_config("display-16")
REQUIREMENTS = build_board_requirements(CONFIG)
PLANNER, WEB, OPERATOR, SUPERVISOR = 1, 2, 3, 4
STEP_S = 0.002


class CuttableLink(MemoryLink):
    """In-memory link through which nothing passes while it is cut."""

    is_cut = False

    def write(self, data):
        if not self.is_cut:
            super().write(data)

    def read(self, timeout_s):
        data = super().read(timeout_s)
        return b"" if self.is_cut else data


class ServiceRig:
    """A link service with its board.

    log: events of the board
    received: messages by client, oldest first
    """

    def __init__(self, on_web_loss="dark", link_type=MemoryLink, settings=None, requirements=REQUIREMENTS):
        self.log = []
        self.clock = ManualClock(5.0)
        self.boards = self.build_boards(link_type, settings, requirements)
        self.service = LinkService(self.boards, self.clock, on_web_loss)
        self.received = {}
        self.alive = {}
        self.request_ids = itertools.count(1)
        self.job_numbers = itertools.count(1)

    def build_boards(self, link_type, settings, requirements):
        self.core = BoardCore(settings, sink=self.log.append, seed=3)
        self.link = link_type(self.core, self.clock)
        self.session = BoardSession(self.link, self.clock, requirements)
        return BoardGroup([self.session], self.clock, [self.open_port])

    def open_port(self):
        self.link.open()
        return True

    # --- clients

    def hello(self, client, role, trusted=True):
        self.received[client] = []
        self.service.on_message(client, Message("hello", {"role": role}), trusted)
        if role in ("planner", "web"):
            self.alive[client] = True

    def hello_all(self):
        for client, role in ((PLANNER, "planner"), (WEB, "web"), (OPERATOR, "operator"), (SUPERVISOR, "supervisor")):
            self.hello(client, role)
        return self

    def leave(self, client):
        self.alive.pop(client, None)
        self.service.on_client_lost(client)
        self.collect()

    def send(self, client, kind, payload=b"", **fields):
        self.service.on_message(client, Message(kind, fields, payload))
        self.collect()

    def request(self, client, kind, payload=b"", **fields):
        request_id = next(self.request_ids)
        self.send(client, kind, payload, id=request_id, **fields)
        return request_id

    def collect(self):
        for clients, message in self.service.pop_outgoing():
            for client in clients:
                self.received[client].append(message)

    def of_kind(self, client, kind):
        return [message for message in self.received[client] if message.kind == kind]

    def find_result(self, client, request_id):
        found = [message.fields for message in self.of_kind(client, "result") if message.fields["id"] == request_id]
        return found[-1] if found else None

    # --- time

    def run(self, duration_s=STEP_S, step_s=STEP_S):
        until_s = self.clock.now_s() + duration_s
        while self.clock.now_s() < until_s:
            for client, alive in self.alive.items():
                if alive is not None:
                    self.service.on_message(client, Message("beat", {"alive": alive}))
            before_s = self.clock.now_s()
            self.service.step(step_s)
            self.collect()
            if self.clock.now_s() == before_s:
                self.clock.sleep(step_s)

    def until(self, condition, patience_s=12.0):
        give_up_s = self.clock.now_s() + patience_s
        while not (result := condition()):
            assert self.clock.now_s() < give_up_s, f"timed out: {self.boards.board}"
            self.run()
        return result

    def await_result(self, client, request_id):
        return self.until(lambda: self.find_result(client, request_id))

    # --- scenes

    def connect(self):
        self.until(lambda: self.boards.connected)
        return self

    def arm(self, client=WEB, **fields):
        result = self.await_result(client, self.request(client, "arm", **fields))
        assert result["error"] is None, result
        return self

    @property
    def epoch(self):
        return self.service.epoch.number

    @property
    def pause_number(self):
        return self.service.pauses.number

    def begin(self, points, epoch=None, start_in_s=0.05, ahead_s=None, crc=None, pause=None):
        """Hand points over as the planner does. Return the number of the job."""
        number, payload = next(self.job_numbers), points.encode_payload()
        fields = {"job": number, "epoch": self.epoch if epoch is None else epoch, "ahead_s": ahead_s}
        fields |= {"pause": self.pause_number if pause is None else pause, "counts": [len(points)]}
        fields |= {"start_s": self.session.board_s() + start_in_s, "crc": zlib.crc32(payload) if crc is None else crc}
        self.send(PLANNER, "begin", payload, **fields)
        return number

    def splice(self, points, kept_points, epoch=None, ahead_s=None, pause=None):
        number, payload = next(self.job_numbers), points.encode_payload()
        fields = {"job": number, "epoch": self.epoch if epoch is None else epoch, "ahead_s": ahead_s}
        fields |= {"pause": self.pause_number if pause is None else pause, "counts": [len(points)]}
        fields |= {"kept_points": [kept_points], "crc": zlib.crc32(payload), "holds_first": False}
        return number, self.find_result(PLANNER, self.request(PLANNER, "splice", payload, **fields))

    def extend(self, number, points, epoch=None, pause=None, crc=None):
        """Append points to a job. Return the result."""
        payload = points.encode_payload()
        fields = {"job": number, "epoch": self.epoch if epoch is None else epoch, "ahead_s": None}
        fields |= {"pause": self.pause_number if pause is None else pause, "counts": [len(points)]}
        fields |= {"crc": zlib.crc32(payload) if crc is None else crc}
        return self.find_result(PLANNER, self.request(PLANNER, "extend", payload, **fields))

    def list_emitted(self):
        """Return (time in s, duty) of all pulses that the board has emitted."""
        return [(event["on_us"] * 1e-6, event["duty"]) for event in self.log if event["event"] == "pulse"]

    def find_refusals(self):
        return [message.fields["reason"] for message in self.of_kind(PLANNER, "job_refused")]
