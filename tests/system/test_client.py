"""`optodrive.client` with a daemon on a simulated board, checked by the board's log."""

import asyncio
import socket
import threading
from contextlib import suppress

import numpy as np
import pytest

from board_fixtures import board_disarmed, daemon_disarmed  # noqa: F401 - fixtures
from optodrive.client import AsyncDisplay, Display
from optodrive.core.errors import BoardFaultError, InputError, LinkError, NotReadyError, OptodriveError, RefusedError
from rig import TOKEN, long_train, wait_for


@pytest.fixture
def display(daemon):
    with Display(daemon.url, TOKEN) as display:
        yield display


def dark_and_disarmed(board):
    wait_for(lambda: board.of("state")[-1]["state"] == "DISARMED", "DISARMED")
    return board.of("gate")[-1]["on"] is False


def test_arm_show_and_the_result(board, daemon):
    with Display(daemon.url, TOKEN) as display:
        assert not display.state().board.is_armed
        assert display.arm().board.is_armed
        heights_um = np.zeros(len(display.layout))
        heights_um[[17, 200]] = 90.0, 120.0
        plan = display.show(heights_um)
        assert (plan.status, plan.executed, plan.fits) == ("done", 2, True)
        np.testing.assert_allclose(plan.heights_um[[17, 200]], [90.0, 120.0], rtol=0.02)
        assert np.count_nonzero(plan.heights_um) == 2
        by_place = np.zeros((21, 21))
        by_place[display.layout.row[200], display.layout.column[200]] = 120.0
        assert display.show(by_place, wait=True).heights_um.argmax() == 200
    assert dark_and_disarmed(board)
    assert [pulse["on"] for pulse in board.of("gate")].count(True) == 3


def test_a_preview_and_a_read_only_client_have_no_effect(board, daemon):
    daemon.arm()
    with Display(daemon.url, TOKEN) as display:
        plan = display.show({17: 90.0}, dry_run=True)
        assert (plan.status, plan.planned, plan.sent) == ("planned", 1, 0)
        assert plan.heights_um[17] == pytest.approx(90.0, rel=0.02)
        assert display.play("pixel", dry_run=True).planned
        assert display.patterns()
        assert plan._repr_png_()[:4] == b"\x89PNG"
        assert display._repr_png_()[:4] == b"\x89PNG"
        assert "display-437" in display._repr_html_()
    assert daemon.board_state() == "ARMED"
    assert not board.of("pulse")


def test_an_exception_stops_the_plan(board, daemon):
    plans = []

    def session():
        with Display(daemon.url, TOKEN) as display:
            display.arm()
            plans.append(display.push(long_train(), wait=False))
            wait_for(lambda: len(board.of("pulse")) > 10, "pulses")
            raise ArithmeticError

    with pytest.raises(ArithmeticError):
        session()
    assert dark_and_disarmed(board)
    assert daemon.finished(plans[0].plan)["error"] == "ended by stop"


def test_errors_have_the_fields_of_the_problem_document(daemon, display):
    with pytest.raises(NotReadyError, match="arm it first") as refused:
        display.show({17: 50.0})
    assert refused.value.problem["status"] == 409
    with pytest.raises(InputError) as refused:
        display.push({"frames": [{"show_at_s": 0, "duration_s": 1, "target_um": {"999": 1}}]})
    assert (refused.value.code, refused.value.problem["code"]) == ("unknown_pixel", "unknown_pixel")
    with pytest.raises(InputError) as refused:
        display.play("no such pattern")
    assert refused.value.code == "unknown_pattern"
    with pytest.raises(InputError) as refused:
        display.plan("p999")
    assert refused.value.code == "plan_not_found"
    with Display(daemon.url, "wrong") as stranger:
        for ask in (stranger.state, stranger.stream):
            with pytest.raises(InputError) as refused:
                ask()
            assert refused.value.code == "bad_token"


def test_a_fault_during_a_plan_is_an_error(make_board, make_daemon):
    board = make_board(script='[[step]]\nfrom = "light"\nat_s = 1.0\nset = "interlock"\nvalue = false\n')
    daemon = make_daemon(board)
    with Display(daemon.url, TOKEN) as display:
        display.arm()
        with pytest.raises(RefusedError, match="INTERLOCK"):
            display.push(long_train(seconds=20.0))
        state = display.state()
        assert state.board.fault == "INTERLOCK"
        assert state.board.hint
        with pytest.raises((BoardFaultError, NotReadyError)):
            display.arm()


def test_a_stream_reports_the_result_of_each_frame(board, daemon):
    with Display(daemon.url, TOKEN) as display:
        display.arm()
        with display.stream() as stream:
            for k in range(20):
                stream.send(dict.fromkeys(range(50 + k), 80.0))
            last = stream.send({5: 100.0})
            done = stream.wait(last)
            assert done.status == "done"
            assert done.simulated_max_um == pytest.approx(100.0, rel=0.02)
            assert done.latency.first_light_s > 0
            final = [result for result in stream.results() if result.is_final]
            assert sorted(result.frame for result in final) == list(range(last + 1))
            with pytest.raises(InputError) as refused:
                stream.wait(stream.send({5: 6000.0}))
            assert refused.value.code == "target_unreachable"
            assert stream.wait(stream.send({7: 60.0})).status == "done"
    assert dark_and_disarmed(board)


def test_a_closed_stream_shows_no_frame(board, daemon):
    """It would otherwise reconnect, as after a broken connection, and nobody would end what it shows."""

    async def send_after_the_block():
        async with AsyncDisplay(daemon.url, TOKEN) as display:
            await display.arm()
            async with display.stream() as stream:
                await stream.wait(await stream.send({5: 100.0}))
            with pytest.raises(NotReadyError, match="the stream is closed"):
                await stream.send({6: 100.0})

    with Display(daemon.url, TOKEN) as display:
        display.arm()
        with display.stream() as stream:
            stream.wait(stream.send({5: 100.0}))
        with pytest.raises(NotReadyError, match="the stream is closed"):
            stream.send({6: 100.0})
    asyncio.run(send_after_the_block())
    assert len(board.of("pulse")) == 2
    assert dark_and_disarmed(board)


def test_a_closed_display_only_stops(board, daemon):
    """Nobody would end what it arms or shows after its block, as by a connection of its own for --hold or a stream."""

    async def use_after_the_block():
        async with AsyncDisplay(daemon.url, TOKEN) as display:
            await display.layout()
            stream = display.stream()
        async with stream:
            for use in (lambda: display.arm(hold=True), lambda: stream.send({5: 100.0}), display.arm, display.state):
                with pytest.raises(NotReadyError, match="this display is closed"):
                    await use()
        await display.stop()

    with Display(daemon.url, TOKEN) as display:
        stream = display.stream()
    for use in (
        lambda: display.arm(hold=True),
        lambda: stream.send({5: 100.0}),
        display.stream,
        display.arm,
        display.state,
        lambda: display.show({5: 100.0}),
    ):
        with pytest.raises(NotReadyError, match="this display is closed"):
            use()
    stream.close()
    assert "this display is closed" in display._repr_html_()
    display.stop()
    asyncio.run(use_after_the_block())
    assert not any(state["state"] == "ARMED" for state in board.of("state"))


def test_the_client_reconnects_to_a_restarted_daemon_that_is_not_armed(make_board, make_daemon, tmp_path, monkeypatch):
    """The new daemon has the same port and another token, which the client reads from its file again."""
    board = make_board()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("OPTODRIVE_TOKEN", raising=False)
    first = make_daemon(board)
    port = first.client.base_url.port
    with Display(first.url, reconnect_timeout_s=120.0) as display:
        display.arm()
        with display.stream() as stream:
            assert stream.wait(stream.send({5: 60.0})).status == "done"
            first.stop()
            restarted = threading.Thread(target=make_daemon, args=(board,), kwargs={"options": ("--port", str(port))})
            with monkeypatch.context() as other:
                other.setattr("rig.TOKEN", "another-token-for-tests")
                restarted.start()
                state = wait_for(lambda: (s := display.state().board.state) != "UNKNOWN" and s, "the board's state")
                assert state == "DISARMED"
                restarted.join()
            with pytest.raises(NotReadyError, match="arm it first"):
                stream.wait(stream.send({6: 60.0}))
        with pytest.raises(NotReadyError, match="arm it first"):
            display.show({5: 60.0})
        assert [state["state"] for state in board.of("state")].count("ARMED") <= 2  # before and after the plan
        assert display.arm().board.is_armed
        assert display.show({5: 60.0}).status == "done"


class DroppingProxy:
    """Proxy that drops the bytes of its first connections on request. Later connections work."""

    def __init__(self, port):
        self._port = port
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        self.swallowing = set()
        self._links, self._sockets = [], []
        threading.Thread(target=self._accept, daemon=True).start()

    def swallow(self):
        self.swallowing = set(self._links)

    def _accept(self):
        while True:
            try:
                caller, _ = self._server.accept()
            except OSError:
                return
            daemon = socket.create_connection(("127.0.0.1", self._port))
            self._links.append(caller)
            self._sockets += [caller, daemon]
            for source, target in ((caller, daemon), (daemon, caller)):
                threading.Thread(target=self._pump, args=(caller, source, target), daemon=True).start()

    def _pump(self, caller, source, target):
        try:
            while data := source.recv(65536):
                if caller not in self.swallowing:
                    target.sendall(data)
        except OSError:
            return

    def close(self):
        for link in (self._server, *self._sockets):
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()


def test_stop_arrives_although_the_old_connection_drops_everything(board, daemon):
    proxy = DroppingProxy(daemon.client.base_url.port)
    try:
        with Display(f"http://127.0.0.1:{proxy.port}", TOKEN) as display:
            display.arm()
            display.push(long_train(seconds=30.0), wait=False)
            wait_for(lambda: len(board.of("pulse")) > 10, "pulses")
            proxy.swallow()
    finally:
        proxy.close()
    assert dark_and_disarmed(board)
    assert board.of("state")[-1]["reason"] == "abort"


def test_a_failed_stop_is_reported_and_hides_no_error(make_board, make_daemon):
    daemon = make_daemon(make_board())

    def session(error):
        with Display(daemon.url, TOKEN) as display:
            with suppress(LinkError):
                display.arm()
            daemon.stop()
            if error is not None:
                raise error

    with pytest.raises(LinkError, match="emergency stop"):
        session(None)
    with pytest.raises(ArithmeticError) as raised:
        session(ArithmeticError())
    assert "emergency stop" in raised.value.__notes__[0]


def test_the_async_client(board, daemon):
    async def session():
        async with AsyncDisplay(daemon.url, TOKEN) as display:
            assert (await display.arm()).board.is_armed
            assert (await display.show({17: 50.0}, dry_run=True)).sent == 0
            plan = await display.show({17: 90.0})
            assert (plan.status, plan.executed) == ("done", 1)
            assert (await display.play("pixel")).status == "done"
            async with display.stream() as stream:
                for _ in range(10):
                    last = await stream.send(dict.fromkeys(range(60), 80.0))
                last = await stream.send({5: 100.0})
                assert (await stream.wait(last)).status == "done"
                assert len([result for result in await stream.results() if result.is_final]) == last + 1
                with pytest.raises(InputError):
                    await stream.wait(await stream.send({5: 6000.0}))
            with pytest.raises(OptodriveError):
                await display.plan("p999")
            waiting = asyncio.create_task(display.push(long_train(seconds=30.0)))
            emitted = len(board.of("pulse"))
            await asyncio.to_thread(wait_for, lambda: len(board.of("pulse")) > emitted + 10, "pulses")
            waiting.cancel()

    asyncio.run(session())
    assert dark_and_disarmed(board)


def test_a_cancelled_task_stops_its_plan(board, daemon):
    async def emit():
        async with AsyncDisplay(daemon.url, TOKEN) as display:
            await display.arm()
            await display.push(long_train(seconds=30.0))

    async def session():
        task = asyncio.create_task(emit())
        await asyncio.to_thread(wait_for, lambda: len(board.of("pulse")) > 10, "pulses")
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(session())
    assert dark_and_disarmed(board)
