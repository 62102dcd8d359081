import json
import socket

import pytest

from optodrive.core.child_process import PACKET_MAX_BYTES, BeatWriter, SupervisorGoneError
from optodrive.core.clock import ManualClock


@pytest.fixture
def ends():
    """Return the supervisor's end, the child's end and the child's clock."""
    supervisor, child = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    supervisor.setblocking(False)
    clock = ManualClock()
    writer = BeatWriter(child.detach(), clock.now_s)
    yield supervisor, writer, clock
    supervisor.close()
    writer.close()


def read_kinds(supervisor):
    kinds = []
    while True:
        try:
            kinds.append(json.loads(supervisor.recv(PACKET_MAX_BYTES))["kind"])
        except BlockingIOError:
            return kinds


def test_beats_are_limited_to_one_per_interval(ends):
    supervisor, writer, clock = ends
    for _ in range(100):  # one second in steps of 10 ms
        writer.beat()
        clock.sleep(0.01)
    assert 9 <= len(read_kinds(supervisor)) <= 10


def test_control_messages_keep_their_boundaries(ends):
    supervisor, writer, _ = ends
    assert writer.receive() == []
    supervisor.send(b'{"kind": "end"}')
    supervisor.send(b'{"kind": "audit", "fields": {}}')
    assert [message["kind"] for message in writer.receive()] == ["end", "audit"]


def test_the_end_of_the_supervisor_is_noticed_and_does_not_stop_a_beat(ends):
    supervisor, writer, clock = ends
    supervisor.close()
    with pytest.raises(SupervisorGoneError):
        writer.receive()
    clock.sleep(1.0)
    writer.beat()


def test_a_supervisor_that_does_not_read_blocks_nobody(ends):
    supervisor, writer, _ = ends
    for _ in range(5000):
        writer.report_failure("x" * 200)
    assert read_kinds(supervisor)
