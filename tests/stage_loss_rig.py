"""One of several boards is lost in virtual time while the others go on, with what the boards' own logs tell of it."""

import numpy as np

from link_service_rig import OPERATOR, WEB
from optodrive.core.errors import LinkError
from optodrive.core.types.plans import EMPTY_PLAN, PulsePlan
from optodrive.link.board_setup import build_scales
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.quantisation import DUTY_MAX
from optodrive.link.protocol.states import LEASED_STATES, BoardState
from stage_rig import DriftingLink, StageRig, build_stages

KINDS = ("kill", "stop", "unplug", "fault", "cut", "mute", "lie")
"""The board is killed, or stopped for a while; its cable is pulled; it has a fault; for a while nothing passes through
its link, or nothing from the board to the host; a report of it is false."""


class LossyLink(DriftingLink):
    """Link that may break in every way, to a board that does not notice it.

    grants: host times at which the board was granted a longer lease, and at which that ends
    """

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.kind = ""
        self.held = b""
        self.grants = []

    def open(self):
        self._require_port()

    def close(self):
        """Leave the board alone: it is to find out by its lease."""

    def write(self, data):
        self._require_port()
        if self.kind == "stop":
            self.held += data
        elif self.kind not in ("cut", "kill"):
            self._receive(data)

    def read(self, timeout_s):
        self._require_port()
        if self.kind == "stop":
            self._clock.sleep(max(timeout_s, 1e-4))
            return b""
        data = super().read(timeout_s)
        return b"" if self.kind in ("cut", "mute") else data

    def _require_port(self):
        if self.kind in ("kill", "unplug"):
            raise LinkError(f"/dev/{self.name}: unplugged")

    def _receive(self, data):
        before_us = self._core.lease_until_us
        self._core.receive(data, self._now_us())
        if self._core.state in LEASED_STATES and self._core.lease_until_us > before_us:
            end_s = self.board_clock.find_true_s(self._core.lease_until_us * 1e-6)
            self.grants.append((self._clock.now_s(), end_s))

    def break_board(self, kind):
        if kind == "fault":
            self._core.set_input("interlock", False, self._now_us())
        elif kind == "kill":
            self._core.on_link_lost(self._now_us())
        self.kind = kind

    def repair(self):
        kind, self.kind = self.kind, ""
        self._core.advance(self._now_us())
        self._core.set_input("interlock", True, self._now_us())
        if kind == "stop":
            held, self.held = self.held, b""
            self._receive(held)


class LossRig(StageRig):
    """Several boards of a display, armed, one of which will be lost.

    pixel_by_codes: pixel at which a beam with these codes points
    """

    def __init__(
        self, monkeypatch, count, name="display-16", on_stage_loss="that_stage", link_type=LossyLink, **changes
    ):
        display = build_stages(name, count, **changes)
        super().__init__(monkeypatch, display, link_type=link_type, on_stage_loss=on_stage_loss)
        self.ready()
        scale, moves = build_scales(display.config)[0], display.scan_head.moves
        codes = zip(scale.to_codes(moves.x_rad).tolist(), scale.to_codes(moves.y_rad).tolist(), strict=True)
        self.pixel_by_codes = {pair: pixel for pixel, pair in enumerate(codes)}
        self.sleep(1.0)
        self.arm()
        self.run(0.01)

    def push(self, sequence, streamed=False):
        return self.store.find(self.submit(sequence, self.remote.epoch, streamed).result().plan)

    def sleep(self, duration_s):
        until_s = self.clock.now_s() + duration_s
        self.until(lambda: self.clock.now_s() >= until_s, duration_s + 1.0)

    def lose(self, stage, kind):
        """Break a board. Return the host time."""
        if kind == "lie":
            event = m.Event(m.STATES.index(BoardState.DISARMED), fault=0, reason=0, tick=0)
            self.boards.sessions[stage]._on_event(event, self.clock.now_s())
            return self.clock.now_s()
        self.links[stage].break_board(kind)
        return self.clock.now_s()

    def stop(self):
        """Stop all boards, and return the result."""
        return self.await_result(OPERATOR, self.request(OPERATOR, "stop"))

    def restore(self, stage):
        """Repair the lost board and arm all boards again."""
        self.links[stage].repair()
        self.until(lambda: self.remote.connected and self.remote.lost is None)
        assert self.await_result(WEB, self.request(WEB, "disarm"))["error"] is None
        self.sleep(2.0)
        self.arm()
        self.run(0.01)

    def collect_emitted(self):
        """Return the pulses of all boards by their own logs as a plan in host time, as a witness of the light."""
        for core, link in zip(self.cores, self.links, strict=True):
            core.advance(link._now_us())
        rows = []
        for stage, (log, clock) in enumerate(zip(self.logs, self.clocks, strict=False)):
            for event in log:
                if event["event"] == "pulse":
                    on_s, off_s = (clock.find_true_s(event[key] * 1e-6) for key in ("on_us", "off_us"))
                    pixel = self.pixel_by_codes[event["x"], event["y"]]
                    rows.append((on_s, off_s - on_s, pixel, stage, event["duty"]))
        on_s, width_s, pixel, stage, duty = np.array(sorted(rows)).reshape(-1, 5).T
        moves, full_w = self.display.scan_head.moves, self.display.config.laser.max_power_w
        pixel = pixel.astype(np.int64)
        blank = {key: np.zeros(len(on_s), dtype=column.dtype) for key, column in vars(EMPTY_PLAN).items()}
        columns = {"pixel": pixel, "stage": stage.astype(np.int64), "start_s": on_s, "width_s": width_s}
        columns |= {"power_w": duty / DUTY_MAX * full_w, "x_rad": moves.x_rad[pixel], "y_rad": moves.y_rad[pixel]}
        return PulsePlan(**blank | columns)
