"""GET /metrics: figures for Prometheus, in its text format, version 0.0.4."""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from optodrive import __version__
from optodrive.core.histogram import Histogram
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.link.session.session import Session

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
LATENCY_S = (0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0)
STATES = ("DISARMED", "ARMING", "ARMED", "RUNNING", "HOLD", "FAULT")
Labels = Mapping[str, str]


class PlanTally:
    """Ended plans, counted: by status, and how long after it was asked for the first light of each fell."""

    def __init__(self) -> None:
        self.ended: Counter[str] = Counter(dict.fromkeys(("done", "superseded", "failed", "cancelled"), 0))
        self.first_light = Histogram(LATENCY_S)
        self.headroom_k: float | None = None

    def note(self, record: PlanRecord) -> None:
        """Count a plan that has ended; the loop's thread and the bookkeeper's, one plan each."""
        self.ended[record.status] += 1
        self.headroom_k = float(record.prepared.plan.headroom_k.min())
        if record.first_light_after_s is not None:
            self.first_light.add(record.first_light_after_s)


def metrics(snapshot: Mapping[str, Any], tally: PlanTally, session: Session, lease_s: float) -> str:
    """The page. snapshot: as GET /v1/state answers it."""
    board, link, totals, queue = (snapshot[key] for key in ("board", "link", "totals", "queue"))
    page = _Page()
    page.gauge("info", "Version and display", [({"version": __version__, "display": snapshot["display"]}, 1)])
    page.gauge("board_state", "1 for the board's state", [({"state": s}, int(board["state"] == s)) for s in STATES])
    page.counter("board_faults_total", "Times the board was seen to go into a fault", _by("fault", session.faults))
    page.counter("laser_on_seconds_total", "Gate-on time × duty since the board's power-up, s", board["laser_on_s"])
    page.counter("underruns_total", "Times the board ran out of points", board["underruns"])
    page.gauge("board_temperature_celsius", "The board's temperature", board["temperature_c"])
    page.gauge("link_up", "1 while there is a link to the board", int(link["state"] == "up"))
    received, sent = {"at": "host"}, {"at": "board"}
    bad = [(received, link["received_bad"]), (sent, link["board_bad"])]
    page.counter("link_bad_frames_total", "Damaged frames since the link was opened", bad)
    page.counter("link_retransmitted_total", "Frames sent again since the link was opened", link["retransmitted"])
    page.counter("link_naks_total", "Frames the board refused since the link was opened", link["naks"])
    page.gauge("link_round_trip_seconds", "Least round trip to the board", _seconds(link["round_trip_ms"]))
    page.gauge("link_longest_stall_seconds", "Longest turn of the loop", _seconds(link["longest_stall_ms"]))
    pulses = [({"stage": stage}, totals[stage]) for stage in ("planned", "sent", "executed")]
    page.counter("pulses_total", "Pulses planned, sent to the board, executed by it", pulses)
    page.counter("plans_total", "Ended plans by how they ended", _by("status", tally.ended))
    page.gauge("plans_waiting", "Plans that wait for the beam", queue["waiting"])
    page.gauge("planner_alive", "1 while the planner is idle or makes progress", int(snapshot["planner"]["alive"]))
    page.gauge(
        "plan_headroom_kelvin", "Least distance of an absorber's bound from its cap, last plan", tally.headroom_k
    )
    page.histogram("first_light_seconds", "From a plan's arrival to its first light", tally.first_light)
    page.histogram("lease_age_seconds", "Age of the lease when it was renewed", session.lease_ages)
    page.gauge("lease_seconds", "Age at which the board goes dark", lease_s)
    page.gauge("lease_slack_seconds", "Least of the lease that was ever left at a renewal", session.lease_slack_s)
    return page.text()


class _Page:
    def __init__(self) -> None:
        self._lines: list[str] = []

    def gauge(self, name: str, meaning: str, value: "float | Iterable[tuple[Labels, float]] | None") -> None:
        """What goes up and down; nothing where it is not known."""
        self._family(name, "gauge", meaning, value)

    def counter(self, name: str, meaning: str, value: "float | Iterable[tuple[Labels, float]]") -> None:
        """What only goes up."""
        self._family(name, "counter", meaning, value)

    def histogram(self, name: str, meaning: str, histogram: Histogram) -> None:
        """Counts by size."""
        self._head(name, "histogram", meaning)
        bounds = [*(repr(bound) for bound in histogram.bounds), "+Inf"]
        counts, total = histogram.cumulative(), histogram.sum
        for bound, count in zip(bounds, counts, strict=True):
            self._sample(f"{name}_bucket", {"le": bound}, count)
        self._sample(f"{name}_sum", {}, total)
        self._sample(f"{name}_count", {}, counts[-1])

    def text(self) -> str:
        """All of it."""
        return "\n".join(self._lines) + "\n"

    def _family(self, name: str, kind: str, meaning: str, value: Any) -> None:
        if value is None:
            return
        self._head(name, kind, meaning)
        for labels, number in [({}, value)] if isinstance(value, int | float) else value:
            self._sample(name, labels, number)

    def _head(self, name: str, kind: str, meaning: str) -> None:
        self._lines += [f"# HELP optodrive_{name} {meaning}.", f"# TYPE optodrive_{name} {kind}"]

    def _sample(self, name: str, labels: Labels, number: float) -> None:
        inside = ",".join(f'{key}="{_escaped(text)}"' for key, text in labels.items())
        self._lines.append(f"optodrive_{name}{f'{{{inside}}}' if inside else ''} {number!r}")


def _by(label: str, counts: Counter[str]) -> list[tuple[Labels, float]]:
    return [({label: name}, count) for name, count in counts.copy().items()]  # another thread may add a name


def _seconds(milliseconds: float | None) -> float | None:
    return None if milliseconds is None else milliseconds * 1e-3


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace("\n", "\\n").replace('"', '\\"')
