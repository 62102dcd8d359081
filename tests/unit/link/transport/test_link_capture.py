import math
import os
import stat
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.core.clock import ManualClock
from optodrive.core.errors import InputError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.framing import Frame, encode_frame
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.virtual_run import MemoryLink
from optodrive.link.transport.link_capture import (
    CLOSED,
    CRC,
    ENTRY,
    FROM_BOARD,
    HEADER,
    KINDS,
    MAGIC,
    OPENED,
    QUEUE_MAX,
    TO_BOARD,
    VERSION,
    CaptureEntry,
    CapturingTransport,
    LinkCapture,
    LinkCaptureWriter,
    pack_entry,
)

ENTRIES = st.lists(
    st.builds(CaptureEntry, st.sampled_from(KINDS), st.floats(0, 1e9, allow_nan=False), st.binary(max_size=300)),
    max_size=12,
)


def write_capture(path, entries):
    writer = LinkCaptureWriter(path, 3.5, [].append)
    for entry in entries:
        writer.record(entry)
    writer.close()
    return LinkCapture(path)


def test_the_capture_has_all_bytes_with_their_times_and_the_link_is_unchanged(tmp_path):
    clock = ManualClock(5.0)
    writer = LinkCaptureWriter(tmp_path / "capture", clock.now_s(), pytest.fail)
    link = CapturingTransport(MemoryLink(BoardCore(seed=3), clock), writer, clock)
    link.open()
    hello = encode_frame(Frame(m.Hello.TYPE, 0, 0, m.Hello(1, 0, 7).encode_body()))
    link.write(hello)
    reply = link.read(0.01)
    assert link.read(0.01) == b""
    link.close()
    link.release()
    capture = LinkCapture(tmp_path / "capture")
    assert list(capture.read_entries()) == [
        CaptureEntry(OPENED, 5.0),
        CaptureEntry(TO_BOARD, 5.0, hello),
        CaptureEntry(FROM_BOARD, 5.0 + 1e-4, reply),
        CaptureEntry(CLOSED, pytest.approx(5.0 + 1e-4 + 0.01)),
    ]
    assert (capture.host_s, capture.ignored_bytes) == (5.0, 0)


@given(ENTRIES, st.data())
def test_a_capture_truncated_or_damaged_anywhere_yields_the_complete_entries_before(tmp_path_factory, entries, data):
    path = tmp_path_factory.mktemp("captures") / "capture"
    write_capture(path, entries)
    whole = path.read_bytes()
    cut = data.draw(st.integers(HEADER.size, len(whole)))
    ends = [HEADER.size]
    for entry in entries:
        ends.append(ends[-1] + len(pack_entry(entry)))
    kept = max(k for k, end in enumerate(ends) if end <= cut)
    path.write_bytes(whole[:cut])
    capture = LinkCapture(path)
    assert list(capture.read_entries()) == entries[:kept]
    assert capture.ignored_bytes == cut - ends[kept]
    if cut < len(whole):
        damaged = bytearray(whole)
        damaged[cut] ^= 1 << data.draw(st.integers(0, 7))
        path.write_bytes(damaged)
        assert list(LinkCapture(path).read_entries()) == entries[:kept]


def test_times_that_are_no_numbers_are_damage(tmp_path):
    """A dump in JSON had NaN, which is no JSON."""
    entries = [CaptureEntry(OPENED, 1.0), CaptureEntry(TO_BOARD, math.nan, b"x"), CaptureEntry(CLOSED, 2.0)]
    assert list(write_capture(tmp_path / "capture", entries).read_entries()) == entries[:1]
    for number, start in enumerate([(math.inf, 0.0), (0.0, math.nan)]):
        path = tmp_path / f"start{number}"
        path.write_bytes(HEADER.pack(MAGIC, VERSION, *start))
        with pytest.raises(InputError, match=r"start: got .*expected finite times"):
            LinkCapture(path)


def test_no_file_is_overwritten_and_other_files_are_rejected_by_name(tmp_path):
    path = tmp_path / "capture"
    write_capture(path, [])
    with pytest.raises(InputError, match=r"--capture.*name that is free"):
        LinkCaptureWriter(path, 0.0, print)
    with pytest.raises(InputError, match="can be written"):
        LinkCaptureWriter(tmp_path / "no" / "b", 0.0, print)
    with pytest.raises(InputError, match="can be read"):
        LinkCapture(tmp_path / "c")
    path.write_bytes(b"text of another program that is longer than a header")
    with pytest.raises(InputError, match="a link capture"):
        LinkCapture(path)
    path.write_bytes(HEADER.pack(MAGIC, VERSION + 1, 0.0, 0.0))
    with pytest.raises(InputError, match=f"version.*{VERSION}, the one"):
        LinkCapture(path)


FULL = """
import resource, signal, sys
from pathlib import Path
from optodrive.link.transport.link_capture import CaptureEntry, LinkCaptureWriter
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
warnings = []
writer = LinkCaptureWriter(Path(sys.argv[1]), 0.0, warnings.append)
for k in range(200):
    writer.record(CaptureEntry("to board", float(k), bytes(100)))
writer.close()
writer.record(CaptureEntry("to board", 1e3, b"afterwards"))
writer.close()
assert not writer.recording
assert len(warnings) == 1 and "stopped" in warnings[0] and "the session continues" in warnings[0], warnings
"""


def test_a_full_disk_is_reported_once_and_the_written_entries_are_readable(tmp_path):
    path = tmp_path / "capture"
    subprocess.run([sys.executable, "-c", FULL, path], check=True)
    entries = list(LinkCapture(path).read_entries())
    assert len(entries) == (2000 - HEADER.size) // (ENTRY.size + 100 + CRC.size)
    assert [entry.host_s for entry in entries] == list(range(len(entries)))


def test_a_disk_that_does_not_respond_costs_bounded_memory_and_no_time(tmp_path):
    """A pipe without a reader replaces the disk: the writer thread blocks, record() does not."""
    warnings = []
    writer = LinkCaptureWriter(tmp_path / "capture", 0.0, warnings.append)
    reading, writing = os.pipe()
    os.dup2(writing, writer._file.fileno())
    assert stat.S_ISFIFO(os.fstat(writer._file.fileno()).st_mode)
    entry = CaptureEntry(TO_BOARD, 0.0, bytes(200))
    for _ in range(2 * QUEUE_MAX):
        writer.record(entry)
    assert len(warnings) == 1
    assert "too slow" in warnings[0]
    assert writer._queue.qsize() <= QUEUE_MAX
    os.close(writing)
    os.close(reading)  # the writer thread gets an error and ends
    writer._thread.join(10)
    assert not writer._thread.is_alive()
