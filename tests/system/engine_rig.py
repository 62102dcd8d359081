"""The engine in this process on a real link process, with a stand-in for the web process."""

import threading
from concurrent.futures import Future

from link_process_rig import BEAT_INTERVAL_S, Client, LinkProcess
from optodrive.core.clock import MonotonicClock
from optodrive.daemon.engine.engine import Engine
from optodrive.daemon.push import BuiltRequest, Push
from optodrive.link.board_setup import build_scales
from optodrive.link.service.link_connection import build_error
from optodrive.link.service.remote_session import RemoteSession
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import warm_up
from rig import PATIENT_LEASE_S, wait_for


class WebStandIn:
    """Client of the link process that beats as the web process does, and sends its commands."""

    def __init__(self, path):
        self._client = Client(path, "web")
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True)
        self._thread.start()

    def _beat(self):
        while not self._closing.wait(BEAT_INTERVAL_S):
            with self._lock:
                self._client.beat()
                self._client.receive()

    def command(self, kind):
        """Send a command, wait for its result and return it. Raise its error."""
        with self._lock:
            self._client.beat()  # as the web process does before it serves; the thread may be late on a busy machine
            request = self._client.request(kind)

        def receive():
            with self._lock:
                self._client.receive()
                return self._client.results.get(request)

        result = wait_for(receive, f"the result of {kind}")
        if result["error"] is not None:
            raise build_error(result["error"])
        return result

    @property
    def status(self):
        """Latest status of the link process."""
        return self._client.status

    def close(self):
        self._closing.set()
        self._thread.join()
        self._client.close()


class RiggedEngine(Engine):
    """An engine whose loop runs in a thread, with the commands of a web process."""

    def __init__(self, folder, config, port):
        display = DisplayModel.from_config(config)
        self.link = LinkProcess(folder, port, lease_s=PATIENT_LEASE_S, config=config)
        session = RemoteSession(build_scales(config), self.link.path, MonotonicClock())
        super().__init__(display, session, MonotonicClock())
        self.failure = None
        self.web = WebStandIn(self.link.path)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run_until_end, name="engine", daemon=True)

    def start(self):
        warm_up(self.display)
        self._thread.start()
        wait_for(lambda: self.is_linked, "the link")
        return self

    def submit_sequence(self, sequence, name="push", streamed=False, **options):
        """Submit a sequence, or the function that returns it, as if it arrived now."""
        push = Push(name, options, self._clock.now_s(), self._session.epoch, streamed=streamed)
        return self.submit(lambda: BuiltRequest(sequence() if callable(sequence) else sequence), push)

    def _run_until_end(self):
        try:
            self.run(self._ending.is_set)
        except Exception as error:
            self.failure = error

    def arm(self):
        wait_for(lambda: self.web.status and not self.web.status["stalled"], "beats of planner and web")
        return self._command("arm", lambda result: self.board_state == "ARMED")

    def stop(self):
        return self._command("stop", lambda result: self._epoch == result["epoch"])

    def _command(self, kind, is_seen):
        """Return a future of the result. It is done once the engine has seen the effect."""
        future = Future()
        try:
            result = self.web.command(kind)
            wait_for(lambda: is_seen(result), f"the effect of {kind}")
            future.set_result(result)
        except Exception as error:
            future.set_exception(error)
        return future

    def stop_loop(self):
        self._ending.set()
        self._thread.join()

    def stop_all(self):
        self.stop_loop()
        self.close()
        self.web.close()
        self.link.stop()
