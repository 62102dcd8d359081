import logging
import os
import socket
from contextlib import closing

import pytest

from optodrive.core.clock import ManualClock
from optodrive.daemon import log as log_module
from optodrive.daemon.log import BYTES_MAX, PERIOD_S, REPEATS_MAX, DaemonLog, format_entry, open_daemon_log


def fields(data):
    """Parse an entry of the journal's native format."""
    found = {}
    while data:
        name, _, rest = data.partition(b"\n")
        if b"=" in name:
            key, _, value = name.partition(b"=")
            data = rest
        else:
            key, size = name, int.from_bytes(rest[:8], "little")
            value, data = rest[8 : 8 + size], rest[9 + size :]
        found[key.decode()] = value.decode()
    return found


@pytest.fixture
def journal(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "journal"))
        listener.setblocking(False)
        yield listener


def test_an_entry_has_its_fields():
    made = fields(format_entry("dark", "err", {"EVENT": "fault"}))
    assert made == {"MESSAGE": "dark", "PRIORITY": "3", "SYSLOG_IDENTIFIER": "optodrive", "OPTODRIVE_EVENT": "fault"}


def test_a_value_cannot_forge_another_field():
    made = fields(format_entry("a\nPRIORITY=0\nMESSAGE=b", "info", {}))
    assert made["MESSAGE"] == "a\nPRIORITY=0\nMESSAGE=b"
    assert made["PRIORITY"] == "6"


def test_text_that_is_no_unicode_is_written_all_the_same():
    """A path of other bytes, or a half of a pair of JSON: a failing log must not end the daemon."""
    made = fields(format_entry("/data/\udcff.h5 \ud800", "info", {"PATH": "\udcff"}))
    assert made["MESSAGE"] == r"/data/\udcff.h5 \ud800"


def test_lines_go_to_the_journal(journal, tmp_path, capsys):
    with closing(DaemonLog(tmp_path / "journal")) as log:
        log.warn("the link went")
    assert fields(journal.recv(9000))["MESSAGE"] == "the link went"
    assert capsys.readouterr().err == ""


def test_a_missing_or_stalled_journal_does_not_block(journal, tmp_path):
    for path in (tmp_path / "journal", tmp_path / "nowhere"):
        with closing(DaemonLog(path)) as log:
            for number in range(5000):
                log.warn(f"{number:1000}")


def test_a_pipe_whose_reader_has_stalled_does_not_block(monkeypatch):
    reader, writer = os.pipe()
    with open(writer, "w") as pipe, closing(DaemonLog(None, clock := ManualClock())) as log:  # noqa: PTH123 - a descriptor
        monkeypatch.setattr("sys.stderr", pipe)
        for number in range(200):  # twice what the pipe holds
            log.warn(f"{number:1000}")
        kept = os.read(reader, 1 << 20).count(b"\n")
        assert 30 < kept < 70
        clock.sleep(PERIOD_S)
        log.warn("read again")
        assert os.read(reader, 1 << 20).endswith(
            f"optodrive: {200 - kept} lines suppressed\noptodrive: read again\n".encode()
        )
    os.close(reader)


def test_the_journal_is_used_only_if_stderr_is_connected_to_it(monkeypatch, tmp_path):
    monkeypatch.setattr(log_module, "JOURNAL", tmp_path)
    there = os.fstat(2)
    for stream, expected in (
        ("", None),
        ("nonsense", None),
        (f"{there.st_dev}:{there.st_ino + 1}", None),
        (f"{there.st_dev}:{there.st_ino}", str(tmp_path)),
    ):
        monkeypatch.setenv("JOURNAL_STREAM", stream)
        with closing(open_daemon_log()) as log:
            assert log._journal == expected


def test_log_records_of_libraries_are_written(capsys):
    root = logging.getLogger()
    before = list(root.handlers)
    log = DaemonLog()
    log.attach_to_root_logger()
    try:
        logging.getLogger("uvicorn.error").error("no good")
        logging.getLogger("uvicorn.error").info("nothing")
    finally:
        root.handlers[:] = before
        log.close()
    assert capsys.readouterr().err == "optodrive: no good\n"


def test_a_minute_of_the_log_is_bounded_and_says_what_is_missing(capsys):
    clock = ManualClock()
    with closing(DaemonLog(None, clock)) as log:
        for number in range(1000):
            log.warn(f"{number:1000}")
        written = capsys.readouterr().err
        assert BYTES_MAX - 2000 < len(written) < BYTES_MAX * 1.05
        kept = written.count("\n")
        clock.sleep(PERIOD_S)
        log.warn("the next minute")
        assert capsys.readouterr().err == (f"optodrive: {1000 - kept} lines suppressed\noptodrive: the next minute\n")
        for number in range(300):
            log.warn(f"{number:1000}")
        capsys.readouterr()
    assert capsys.readouterr().err.endswith("lines suppressed\n")


def test_equal_lines_are_merged_and_counted(capsys):
    """A caller without a token can provoke records of a library as often as it likes."""
    clock = ManualClock()
    with closing(DaemonLog(None, clock)) as log:
        for number in range(1000):
            log.write("Invalid HTTP request received.", "warning", LOGGER="uvicorn.error")
            if number % 100 == 0:
                log.warn(f"another {number // 300}")
        lines = capsys.readouterr().err.splitlines()
        assert lines.count("optodrive: Invalid HTTP request received.") == REPEATS_MAX
        assert len(lines) == REPEATS_MAX + 10
        clock.sleep(PERIOD_S)
        log.warn("the next minute")
        log.warn("another 0")
        assert capsys.readouterr().err.splitlines() == [
            f"optodrive: {1000 - REPEATS_MAX} times more: Invalid HTTP request received.",
            "optodrive: the next minute",
            "optodrive: another 0",
        ]


def test_events_are_never_merged(capsys):
    with closing(DaemonLog(None, ManualClock())) as log:
        for _ in range(10):
            log.write("the web process was killed; it starts again", "err", EVENT="restarted")
    assert capsys.readouterr().err.count("starts again") == 10


def test_one_line_is_bounded(capsys):
    with closing(DaemonLog(None, ManualClock())) as log:
        log.warn("x" * 1_000_000)
    assert len(capsys.readouterr().err) < 9000
