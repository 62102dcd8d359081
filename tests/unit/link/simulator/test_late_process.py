"""A process that ran late processes bytes as of an earlier time, but tells the clock's present one."""

from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import HostConnection
from optodrive.link.simulator.board_core import BoardCore


def test_the_reply_to_a_clock_request_tells_the_present_time():
    core, host = BoardCore(seed=1), HostConnection()
    core.read_present_us = lambda: 900_000
    host.send_hello(7)
    core.receive(host.bytes_to_send(0.5, 4096), 500_000)
    host.receive_bytes(core.bytes_to_send(), 0.5)
    host.send(m.ClockRequest(host_t=3))
    core.receive(host.bytes_to_send(0.6, 4096), 600_000)
    (reply,) = [message for message in host.receive_bytes(core.bytes_to_send(), 0.6) if type(message) is m.ClockReply]
    assert (reply.host_t, reply.tick) == (3, 900_000)
    assert core.machine.now_us == 600_000
