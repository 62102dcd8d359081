"""`optodrive osc` with a daemon and its board, and liblo's oscsend as the source."""

import os
import shutil
import socket
import subprocess

import numpy as np
import pytest

from forked_process import OPTODRIVE, run_process, start_process
from optodrive.client.osc_packets import build_message, parse_packet
from rig import TOKEN, read_role_tokens, wait_for
from test_six_experiments import cell_codes

OSCSEND = shutil.which("oscsend")


def environment(daemon, token=TOKEN):
    return {**os.environ, "OPTODRIVE_TOKEN": token, "OPTODRIVE_URL": daemon.url}


@pytest.fixture
def started(kept):
    """Yield board, daemon, the bridge's port and its process."""
    board, daemon = kept
    if daemon.board_state() == "DISARMED":
        daemon.arm()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as replies:
        replies.bind(("127.0.0.1", 0))
        replies.settimeout(60)
        place = f"127.0.0.1:{replies.getsockname()[1]}"
        command = [OPTODRIVE, "osc", "--listen", "127.0.0.1:0", "--reply", place]
        process = start_process(
            command, env=environment(daemon), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        try:
            line = process.stdout.readline()
            assert line.startswith("437 pixels at 127.0.0.1:"), line + process.stderr.read()
            yield board, daemon, int(line.split(";")[0].rpartition(":")[2]), replies
        finally:
            process.kill()
            process.communicate()


def find_pixels(board, since):
    codes = cell_codes()
    pulses = board.of("pulse")[since:]
    return {int(np.abs(codes - (pulse["x"], pulse["y"])).sum(axis=1).argmin()) for pulse in pulses}


@pytest.mark.skipif(OSCSEND is None, reason="liblo-tools are not installed: scripts/test-packages")
def test_another_programs_messages_light_the_pixels_that_they_name(started):
    board, _, port, _ = started
    since = len(board.of("pulse"))
    for arguments in (["/pixel", "ifif", "17", "60", "200", "40"], ["/pixel/30", "f", "50"], ["/clear"]):
        subprocess.run([OSCSEND, "127.0.0.1", str(port), *arguments], check=True, timeout=30)
        if arguments[0] != "/clear":
            expected = {17, 200} if arguments[0] == "/pixel" else {17, 200, 30}
            wait_for(lambda expected=expected: find_pixels(board, since) == expected, f"pulses at {expected}")


def test_the_rate_shown_is_reported_and_stop_stops(started):
    _, daemon, port, replies = started
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as source:
        source.sendto(build_message("/pixel", 17, 60.0), ("127.0.0.1", port))

        def is_shown():
            (message,) = parse_packet(replies.recv(1000))
            assert message.address == "/shown"
            return message.arguments[2] == 1

        wait_for(is_shown, "the report of the frame")
        source.sendto(build_message("/stop"), ("127.0.0.1", port))
    wait_for(lambda: daemon.board_state() == "DISARMED", "the stop")


def test_a_viewer_is_refused(kept):
    _, daemon = kept
    viewer = read_role_tokens(daemon)["viewer"]
    ended = run_process(
        [OPTODRIVE, "osc", "--listen", "127.0.0.1:0"], env=environment(daemon, viewer), capture_output=True, text=True
    )
    assert ended.returncode == 1
    assert ended.stderr.count("\n") == 1
    assert "requires a token of role operator" in ended.stderr
