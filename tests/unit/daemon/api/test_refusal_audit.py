import asyncio
import json

import pytest

from optodrive.core.clock import ManualClock
from optodrive.daemon.api import audit as audit_module
from optodrive.daemon.api.audit import ENTRIES_MAX, PERIOD_S, AuditLog, RefusalAudit


@pytest.fixture
def audit(tmp_path):
    audit = AuditLog(tmp_path / "audit.jsonl", print)
    yield audit
    audit.close()


@pytest.fixture
def read(audit, tmp_path):
    def read():
        audit.close()
        entries = [json.loads(line) for line in (tmp_path / "audit.jsonl").read_text().splitlines()]
        return [{key: value for key, value in entry.items() if key != "at"} for entry in entries]

    return read


def test_a_flood_of_one_kind_is_counted_and_hides_no_other_kind(audit, read):
    clock = ManualClock()
    refusals = RefusalAudit(audit, clock.now_s)

    async def flood():
        for number in range(500):
            refusals.record("bad_token", {"number": number})
        refusals.record("host_not_allowed", {"number": 0})
        clock.sleep(PERIOD_S)
        refusals.record("bad_token", {"number": 500})

    asyncio.run(flood())
    entries = read()
    numbers = [entry["number"] for entry in entries if entry["code"] == "bad_token" and "number" in entry]
    assert numbers == [*range(ENTRIES_MAX), 500]
    assert {"event": "refused", "code": "bad_token", "suppressed": 500 - ENTRIES_MAX} in entries
    assert {"event": "refused", "code": "host_not_allowed", "number": 0} in entries


def test_the_count_is_written_when_the_period_ends_without_another_refusal(audit, read, monkeypatch):
    monkeypatch.setattr(audit_module, "PERIOD_S", 0.05)

    async def flood():
        refusals = RefusalAudit(audit)
        for _ in range(ENTRIES_MAX + 7):
            refusals.record("bad_token", {})
        await asyncio.sleep(0.2)

    asyncio.run(flood())
    assert read()[-1] == {"event": "refused", "code": "bad_token", "suppressed": 7}


def test_a_flush_writes_the_counts(audit, read):
    async def flood():
        refusals = RefusalAudit(audit)
        for _ in range(ENTRIES_MAX + 3):
            refusals.record("bad_token", {})
        refusals.flush()

    asyncio.run(flood())
    assert read()[-1]["suppressed"] == 3
