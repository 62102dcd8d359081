import asyncio
import json
import os
import resource
import subprocess
import sys
import threading
from datetime import UTC, datetime

import pytest

from optodrive.daemon.api import audit as audit_module
from optodrive.daemon.api.audit import AuditLog

NOW = datetime(2026, 1, 2, 3, 4, 5, 678_900, tzinfo=UTC)


@pytest.fixture
def reports():
    return []


@pytest.fixture
def audit(tmp_path, reports):
    audit = AuditLog(tmp_path / "audit.jsonl", reports.append, lambda: NOW)
    yield audit
    audit.close()


def read_entries(folder):
    return [json.loads(line) for line in (folder / "audit.jsonl").read_text().splitlines()]


def test_entries_are_appended_in_order(audit, tmp_path, reports):
    (tmp_path / "audit.jsonl").write_text('{"event": "older"}\n')
    for number in range(5):
        audit.record({"event": "push", "number": number})
    assert asyncio.run(audit.record_durably({"event": "requested"})) is None
    assert [line["event"] for line in read_entries(tmp_path)] == ["older", *["push"] * 5, "requested"]
    assert read_entries(tmp_path)[1]["at"] == "2026-01-02T03:04:05.678+00:00"
    assert reports == []


def test_a_new_file_is_private_to_its_owner(audit, tmp_path):
    asyncio.run(audit.record_durably({"event": "requested"}))
    assert (tmp_path / "audit.jsonl").stat().st_mode & 0o777 == 0o600


def test_one_entry_is_one_line_whatever_it_contains(audit, tmp_path):
    asyncio.run(audit.record_durably({"call": 'POST /v1/patterns/a\n{"event": "armed"}\r\u2028'}))
    assert len((tmp_path / "audit.jsonl").read_text().splitlines()) == 1


def test_a_disk_that_is_full_is_said_once_and_again_when_it_is_not(audit, tmp_path, reports):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        assert asyncio.run(audit.record_durably({"event": "requested"})) is None
        for _ in range(3):
            assert "large" in asyncio.run(audit.record_durably({"event": "requested", "more": "x" * 50}))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert len(reports) == 1
    assert "arming is refused" in reports[0]
    assert asyncio.run(audit.record_durably({"event": "after"})) is None
    first, incomplete, last = read_entries(tmp_path)  # every line is JSON, and what was cut off is quoted
    assert [entry["event"] for entry in (first, incomplete, last)] == ["requested", "incomplete", "after"]
    assert incomplete["line"].startswith('{"at": "2026')
    assert "again" in reports[1]


@pytest.mark.parametrize("torn", ['{"at": "2026-01-01", "ev', "x", '{"at": "\\', "a" * 30_000])
def test_a_line_that_an_earlier_process_left_incomplete_is_quoted_at_the_next_start(tmp_path, reports, torn):
    path = tmp_path / "audit.jsonl"
    path.write_text(f'{{"event": "older"}}\n{torn}')
    first = AuditLog(path, reports.append, lambda: NOW)
    first.close()  # without an entry
    assert [entry["event"] for entry in read_entries(tmp_path)] == ["older", "incomplete"]
    assert read_entries(tmp_path)[1]["line"] == torn
    size = path.stat().st_size
    second = AuditLog(path, reports.append, lambda: NOW)
    second.close()
    assert path.stat().st_size == size
    assert reports == []


def test_an_incomplete_line_stays_whole_while_there_is_no_room_to_quote_it(tmp_path, reports):
    path, torn = tmp_path / "audit.jsonl", '{"event": "stop", "na'
    path.write_text(f'{{"event": "older"}}\n{torn}')
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 10, hard))
    try:
        audit = AuditLog(path, reports.append, lambda: NOW)
        assert asyncio.run(audit.record_durably({"event": "requested"})) is not None
        assert path.read_bytes() == before
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert asyncio.run(audit.record_durably({"event": "after"})) is None
    audit.close()
    assert [entry.get("line") for entry in read_entries(tmp_path)] == [None, torn, None]


def test_a_blocked_disk_delays_nothing(audit, reports, monkeypatch):
    go_on = threading.Event()
    monkeypatch.setattr(audit_module, "WRITE_TIMEOUT_S", 0.05)
    monkeypatch.setattr(audit, "_append", lambda *_: go_on.wait())
    for _ in range(3 * audit_module.QUEUE_MAX):
        audit.record({"event": "stop"})
    assert "too many entries" in asyncio.run(audit.record_durably({"event": "requested"}))
    go_on.set()


def test_a_durable_entry_has_a_timeout(audit, monkeypatch):
    go_on = threading.Event()
    monkeypatch.setattr(audit_module, "WRITE_TIMEOUT_S", 0.05)
    monkeypatch.setattr(audit, "_append", lambda *_: go_on.wait())
    assert "not written within" in asyncio.run(audit.record_durably({"event": "requested"}))
    go_on.set()


def test_a_pipe_that_nobody_reads_is_an_error_at_once(audit, tmp_path, reports):
    os.mkfifo(tmp_path / "audit.jsonl")
    assert asyncio.run(audit.record_durably({"event": "requested"})) is not None
    assert "cannot be written" in reports[0]


HUNG_WRITER = """
import sys, time
from pathlib import Path
from optodrive.daemon.api import audit
audit.WRITE_TIMEOUT_S = 0.2
log = audit.AuditLog(Path(sys.argv[1]), print)
log._append = lambda *_: time.sleep(600)
log.record({"event": "stop"})
log.close()
"""


def test_a_write_that_hangs_does_not_keep_the_process_from_ending(tmp_path):
    command = [sys.executable, "-c", HUNG_WRITER, tmp_path / "audit.jsonl"]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "its last entries may be missing" in ended.stdout
