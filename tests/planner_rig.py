"""The planner in virtual time: its real queue and session over the real link service and a simulated board."""

from concurrent.futures import Executor, Future
from pathlib import Path
from types import MappingProxyType, SimpleNamespace

import numpy as np

from displays import DISPLAYS
from link_service_rig import PLANNER, ServiceRig
from optodrive.core.ipc import MessageDecoder, encode_message
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.daemon.engine.active_plan import PlanStore
from optodrive.daemon.engine.kept_heat import KeptHeat
from optodrive.daemon.engine.plan_making import NEVER, Dimmer, PlanningRequest
from optodrive.daemon.engine.plan_queue import PlanQueue
from optodrive.daemon.engine.plan_rest import ThermalMemory
from optodrive.daemon.engine.planner import Planner
from optodrive.daemon.push import BuiltRequest, Push
from optodrive.link.board_setup import build_scales
from optodrive.link.service import link_connection
from optodrive.link.service.remote_session import RemoteSession

DISPLAY = DISPLAYS["display-16"]


class InlineExecutor(Executor):
    """Runs each function at once, in the caller's thread."""

    def submit(self, function, /, *arguments, **named):
        future = Future()
        try:
            future.set_result(function(*arguments, **named))
        except BaseException as error:
            future.set_exception(error)
        return future


class ServiceChannel:
    """Connection of the planner's session to a link service in the same thread. Messages pass through their bytes."""

    wants_write = False
    is_closed = False

    def __init__(self, rig):
        self._rig = rig
        self._read = 0
        self._decoder = MessageDecoder()

    def fileno(self):
        return -1

    def send(self, message):
        (copy,) = MessageDecoder().feed(encode_message(message))
        self._rig.service.on_message(PLANNER, copy)
        self._rig.collect()

    def flush(self):
        pass

    def receive(self):
        self._rig.collect()
        waiting = self._rig.received[PLANNER][self._read :]
        self._read += len(waiting)
        return self._decoder.feed(b"".join(encode_message(message) for message in waiting))

    def close(self):
        self._rig.leave(PLANNER)


class LiveRecord:
    """The newest record of a plan, as long as the store has it."""

    def __init__(self, newest):
        self.newest = newest

    def __getattr__(self, name):
        return getattr(self.newest, name)


class LiveStore(PlanStore):
    """Store that returns the same object for a plan each time, which always is its newest record."""

    def __init__(self):
        super().__init__()
        self._live = {}

    def publish(self, record):
        super().publish(record)
        self._follow(record)

    def end(self, plan, status, error):
        plan = super().end(plan, status, error)
        self._follow(plan.record)
        return plan

    def _follow(self, record):
        self._live.setdefault(record.plan_id, LiveRecord(record)).newest = record

    def find(self, plan_id):
        return self._live[super().find(plan_id).plan_id]

    def list_recent(self):
        return [self._live[record.plan_id] for record in super().list_recent()]


class PlannerRig(ServiceRig):
    """Planner, queue and session on a link service with its board, in one thread and in virtual time.

    before_loop_action: called before each action that the planner hands over to the loop, that is, between planning
    and commit
    """

    def __init__(self, monkeypatch, queue_type=PlanQueue, display=DISPLAY, **options):
        super().__init__(**options)
        # A reply is there as soon as the request has been sent.
        monkeypatch.setattr(link_connection, "select", SimpleNamespace(select=lambda *_: ([], [], [])))
        self.hello_all()
        self.remote = RemoteSession(build_scales(display.config), Path("nowhere"), self.clock)
        self.remote.connection.attach(ServiceChannel(self))
        self.display, self.store = display, LiveStore()
        self.queue = queue_type(display, self.remote, self.store, InlineExecutor())
        self.before_loop_action = lambda: None
        self.dimmer = Dimmer(display, ThermalMemory())
        self.heat = KeptHeat(display, self.remote, self.queue, self.clock, InlineExecutor(), "a daemon")
        self.planner = Planner(
            self.dimmer,
            self.remote,
            self.queue,
            self.clock,
            InlineExecutor(),
            self._run_in_loop,
            lambda: self.heat.require_known(),
        )
        self._seen_epoch = None

    def _run_in_loop(self, action):
        self.before_loop_action()
        return action()

    def run(self, duration_s=0.002):
        super().run(duration_s)
        self.loop_once()

    def loop_once(self):
        """Run one iteration of the engine's loop."""
        self.remote.connection.receive()
        shift_s = self.remote.pop_clock_shift()
        if self.remote.epoch != self._seen_epoch:
            self._seen_epoch = self.remote.epoch
            self.queue.end_epoch(self.remote.epoch_reason, shift_s or 0.0)
        if shift_s is not None:
            self.queue.on_board_restarted(shift_s)
        self.queue.update_jobs(self.remote.pop_refusal())
        self.planner.follow_queue()
        self.heat.follow(False)
        if self.heat.may_emit:
            self.queue.start_next()

    def submit(
        self,
        sequence,
        epoch,
        streamed=False,
        caller="",
        options=MappingProxyType({}),
        caller_left=NEVER,
        lists_pulses=True,
        refreshes=False,
    ):
        """Plan a sequence. Return its future. A streamed one grows unless its answer lists its pulses."""
        push = Push("push", options, self.clock.now_s(), epoch, caller, streamed, lists_pulses, refreshes=refreshes)
        request = PlanningRequest(lambda: BuiltRequest(sequence), push, self.remote.board_s(), caller_left)
        return self.planner.submit(request)

    def ready(self):
        """Connect, and wait for the planner's view of it."""
        self.connect()
        self.until(lambda: self.remote.connected)
        return self


def build_frame(height_um=60.0, pixels=range(16), duration_s=1.0, count=16):
    target_m = np.zeros(count)
    target_m[list(pixels)] = height_um * 1e-6
    return FrameSequence((TactileFrame("f", 0.0, duration_s, target_m),))


def build_train(seconds, pixel=3):
    return FrameSequence((), (PulseTrain(pixel, 0.0, seconds, 0.01, 0.01, 1.0),))
