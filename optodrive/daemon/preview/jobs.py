"""The jobs of the preview process: parse and build a pushed body, or plan it without executing it."""

import pickle
from collections.abc import Mapping
from typing import Any, NamedTuple

from optodrive.core.errors import InputError, OptodriveError
from optodrive.core.ipc import Message
from optodrive.core.json_model import iterate_json
from optodrive.core.types.stimuli import FrameSequence
from optodrive.daemon.engine.dimmer import dim_display
from optodrive.daemon.engine.dry_run import DryRunStart
from optodrive.daemon.engine.plan_making import NO_LABELS, PlanningRequest, make_plan
from optodrive.daemon.engine.planning_snapshot import PlanningSnapshot
from optodrive.daemon.engine.thermal_estimate import ThermalEstimate
from optodrive.daemon.responses.error_problem import build_error_problem
from optodrive.daemon.responses.plan import PlanReport
from optodrive.link.protocol.quantisation import WireScale
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.stimuli.labels import parse_labels
from optodrive.planning.stimuli.pattern_registry import build_pattern, find_pattern
from optodrive.planning.stimuli.sequence_codec import encode_sequence
from optodrive.planning.stimuli.sequence_file import parse_json, parse_request

DRY_RUN_PLAN = "dry-run"
"""Plan id of every dry run."""


class BuiltRequest(NamedTuple):
    """Sequence of a body, labels of its caller, and all parameters of its pattern, in the units of their names."""

    sequence: FrameSequence
    labels: Mapping[str, str | int | float | bool] = NO_LABELS
    parameters: Mapping[str, str | float | bool | None] = NO_LABELS


def run_job(display: DisplayModel, scale: WireScale, job: Message) -> Message:
    """Do a job and return its result: status and payload, or the status and the document of a problem."""
    try:
        body, start = _split_payload(job)
        built = build_sequence(display, job.fields["source"], job.fields["name"], body)
        if start is None:
            fields = {"status": 200, "labels": dict(built.labels), "parameters": dict(built.parameters)}
            return Message("result", fields, encode_sequence(built.sequence))
        report = plan_dry_run(display, scale, built, start, job.fields)
        audit = {"plan": report.plan, "pattern": report.name, "pulses": report.planned, "plan_status": report.status}
        return Message("result", {"status": 200, "audit": audit}, b"".join(iterate_json(report)))
    except OptodriveError as error:
        return build_refusal(error)


def build_refusal(error: OptodriveError) -> Message:
    """Build the result that describes an error."""
    problem = build_error_problem(error)
    return Message("result", {"status": problem.status}, problem.to_json())


def _split_payload(job: Message) -> tuple[bytes, DryRunStart | None]:
    """Return the body, and the start of a dry run."""
    if job.kind == "build":
        return job.payload, None
    snapshot_bytes = job.fields["snapshot_bytes"]
    start: DryRunStart = pickle.loads(job.payload[:snapshot_bytes])  # noqa: S301 - from the planner process
    return job.payload[snapshot_bytes:], start


def build_sequence(display: DisplayModel, source: str, name: str, body: bytes) -> BuiltRequest:
    """Build the sequence of a body: of FRAMES.json, or of the parameters of the named pattern. Raise InputError."""
    if source == "sequence":
        return BuiltRequest(*parse_request(body, display.config, "body"))
    decoded = parse_json(body, "body") if body.strip() else {}
    if not isinstance(decoded, dict):
        raise InputError("body", decoded, "an object of the pattern's parameters")
    labels = parse_labels(decoded.pop("labels", {}), "body: labels")
    sequence = build_pattern(name, decoded, display.config)
    return BuiltRequest(sequence, labels, find_pattern(name).describe_arguments(decoded, display.config))


def plan_dry_run(
    display: DisplayModel, scale: WireScale, built: BuiltRequest, start: DryRunStart, fields: dict[str, Any]
) -> PlanReport:
    """Plan and prove a sequence without executing it. Raise InputError or RefusedError as the planner does."""
    sequence = built.sequence
    request = PlanningRequest(
        lambda: sequence,
        fields["name"],
        fields["policy"],
        fields["fit"],
        labels=built.labels,
        parameters=built.parameters,
    )
    thermal = ThermalEstimate(start.heat, start.budget)
    snapshot = PlanningSnapshot(thermal, start.starts_in_s, start.heat, start.budget)
    dimmed = dim_display(display, start.power_share)
    plan = make_plan(dimmed, scale, request, sequence, snapshot, DRY_RUN_PLAN, lambda fraction: None)
    return plan.record.build_report(0.0)
