"""Main function of the preview process.

One thread serves the connections and the workers. It starts no other threads, because it forks.
"""

import signal
import time
from dataclasses import dataclass

from optodrive.core.child_process import BeatWriter, SupervisorGoneError
from optodrive.core.errors import OptodriveError
from optodrive.core.ipc import Message, MessageSocket
from optodrive.daemon.message_loop import MessageLoop, MessageServer
from optodrive.daemon.preview.jobs import WAITING_MAX, Job, JobQueue, build_busy_error, build_refusal, run_job
from optodrive.daemon.preview.worker import JobRunner, Worker, build_timeout_error
from optodrive.daemon.runtime_folder import RuntimeFolder
from optodrive.link.board_setup import build_scales
from optodrive.planning.display_model import DisplayModel

QUICK_MAX, HEAVY_MAX = 2, 3
"""Usual builds at once, and dry runs and slow builds at once, one of a caller: a usual build waits for usual ones only.

A build that turns out to be slow while too many heavy jobs run is ended, and begins again when it is its turn: callers
take turns, so that one waits for one heavy job of each other caller at most.
"""
LOOP_WAIT_S, ENDING_WAIT_S = 0.1, 0.01
"""Longest wait for messages, usually and while a worker ends."""


@dataclass
class _Slot:
    """A worker with its job, which counts as running until a killed process has ended, because it holds its memory.

    is_lost: the process has ended by itself, so the job has no answer yet
    """

    worker: Worker
    job: Job | None = None
    is_lost: bool = False


class PreviewServer:
    """Server of preview.sock with its workers."""

    def __init__(self, loop: MessageLoop, folder: RuntimeFolder, run: JobRunner) -> None:
        self._loop = loop
        self._run = run
        self._queue = JobQueue()
        self._slots: list[_Slot] = []
        self._ending: list[_Slot] = []
        self._server = MessageServer(loop, folder.preview_socket, self._on_request, self._on_client_lost)
        self._add_spare()

    def step(self) -> None:
        """Wait for messages for a short time, and end the jobs that have exceeded their time."""
        next_check_s = min((slot.worker.next_check_s for slot in self._slots), default=float("inf"))
        wait_s = ENDING_WAIT_S if self._ending else LOOP_WAIT_S
        self._loop.poll(min(wait_s, next_check_s - time.monotonic()))
        now_s = time.monotonic()
        for slot in list(self._slots):
            if slot.job is None:
                continue
            if now_s >= slot.worker.deadline_s:
                self._reply(slot.job, build_refusal(build_timeout_error(slot.job.message.kind)))
                self._end_worker(slot)
            elif not slot.job.is_heavy and slot.worker.is_slow(now_s):
                self._treat_as_slow(slot, slot.job._replace(is_slow=True))
        self._collect_ended()
        self._start_jobs()

    def close(self) -> None:
        """End all workers and connections."""
        for slot in self._slots:
            self._loop.remove(slot.worker.connection)
            slot.worker.kill()
        for slot in (*self._slots, *self._ending):
            slot.worker.collect(waits=True)
        self._slots.clear()
        self._ending.clear()
        self._server.close()

    def _on_request(self, client: MessageSocket, message: Message) -> None:
        if message.kind == "drop":
            self._drop(client, message.fields["id"])
        elif message.kind in ("build", "dry_run"):
            job = Job(client, message)
            try:
                displaced = self._queue.add(job)
            except OptodriveError as error:
                self._reply(job, build_refusal(error))
            else:
                if displaced is not None:
                    self._reply(displaced, build_refusal(build_busy_error(WAITING_MAX[message.kind])))
            self._start_jobs()

    def _on_client_lost(self, client: MessageSocket) -> None:
        self._drop(client, None)

    def _drop(self, client: MessageSocket, job_id: int | None) -> None:
        """Drop the waiting jobs of a lost caller, and end the workers of its running ones."""
        self._queue.drop(client, job_id)
        for slot in list(self._slots):
            if slot.job is not None and slot.job.client is client and job_id in (None, slot.job.job_id):
                self._end_worker(slot)

    def _treat_as_slow(self, slot: _Slot, job: Job) -> None:
        """Let a build that takes longer than usual go on beside the usual ones, or wait for its turn to do so."""
        if self._may_start(job):
            slot.job = job
            slot.worker.demote()
            return
        slot.job = None
        self._end_worker(slot)
        self._queue.put_back(job)

    def _list_running(self) -> list[Job]:
        return [slot.job for slot in (*self._slots, *self._ending) if slot.job is not None]

    def _may_start(self, job: Job) -> bool:
        running = self._list_running()
        heavy = [other.caller for other in running if other.is_heavy]
        if job.is_heavy:
            return len(heavy) < HEAVY_MAX and job.caller not in heavy
        return len(running) - len(heavy) < QUICK_MAX

    def _start_jobs(self) -> None:
        """Start waiting jobs while the limits permit it. A spare worker is always ready."""
        while job := self._queue.take(self._may_start, {job.caller for job in self._list_running()}):
            slot = next((slot for slot in self._slots if slot.job is None), None) or self._add_spare()
            slot.job = job
            slot.worker.begin(job.message, time.monotonic(), job.is_heavy)
            self._loop.send(slot.worker.connection, job.message)
            if all(slot.job is not None for slot in self._slots):
                self._add_spare()

    def _add_spare(self) -> _Slot:
        slot = _Slot(Worker(self._run))
        self._slots.append(slot)
        self._loop.add(
            slot.worker.connection,
            lambda connection, message: self._on_result(slot, message),
            lambda connection: self._on_worker_lost(slot),
        )
        return slot

    def _on_result(self, slot: _Slot, result: Message) -> None:
        if slot.job is not None:
            self._reply(slot.job, result)
        slot.worker.finish()
        if slot.worker.is_reusable:
            slot.job = None
        else:
            self._end_worker(slot)
        self._start_jobs()

    def _on_worker_lost(self, slot: _Slot) -> None:
        slot.is_lost = True
        self._slots.remove(slot)
        slot.worker.kill()
        self._ending.append(slot)

    def _end_worker(self, slot: _Slot) -> None:
        self._slots.remove(slot)
        self._loop.remove(slot.worker.connection)
        slot.worker.kill()
        self._ending.append(slot)
        if not any(slot.job is None for slot in self._slots):
            self._add_spare()

    def _collect_ended(self) -> None:
        """Forget the workers whose process has ended, and answer the jobs of those that ended by themselves."""
        for slot in list(self._ending):
            error = slot.worker.collect()
            if error is None:
                continue
            self._ending.remove(slot)
            if slot.is_lost and slot.job is not None:
                self._reply(slot.job, build_refusal(error))

    def _reply(self, job: Job, result: Message) -> None:
        fields = {**result.fields, "id": job.job_id}
        self._loop.send(job.client, result._replace(fields=fields))


def run_preview(display: DisplayModel, folder: RuntimeFolder, beat: BeatWriter) -> None:
    """Serve previews until SIGTERM or the end of the supervisor."""
    scales = build_scales(display.config)
    loop = MessageLoop()
    server = PreviewServer(loop, folder, lambda job: run_job(display, scales, job))
    ending: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: ending.append(number))
    loop.watch(beat, beat.receive)
    beat.report_ready()
    try:
        while not ending:
            beat.beat()
            server.step()
    except SupervisorGoneError:
        return
    finally:
        server.close()
