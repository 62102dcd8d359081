"""Repetition of the checks of `optodrive doctor`."""

import re
from collections.abc import Callable, Iterator

from optodrive.cli.doctor_finding import Finding
from optodrive.core.clock import Clock

INTERVAL_S = 2.0
NUMBER = re.compile(r"\d+(?:\.\d+)?")


def watch(examine: Callable[[], list[Finding]], clock: Clock) -> Iterator[list[Finding]]:
    """Yield all findings, and then, every INTERVAL_S, those that changed, without end.

    Numbers that vary, such as a round trip, are no change.
    """
    before: set[tuple[str, str, str]] = set()
    while True:
        findings = examine()
        changed = [finding for finding in findings if _build_key(finding) not in before]
        if changed:
            yield changed
        before = {_build_key(finding) for finding in findings}
        clock.sleep(INTERVAL_S)


def _build_key(finding: Finding) -> tuple[str, str, str]:
    return finding.check, finding.status, NUMBER.sub("#", finding.observation)
