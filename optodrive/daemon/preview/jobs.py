"""The jobs of the preview process: parse and build a pushed body, or plan it without executing it."""

import pickle
from collections.abc import Sequence

from optodrive.core.errors import OptodriveError
from optodrive.core.ipc import Message
from optodrive.core.json_model import iterate_json
from optodrive.daemon.engine.dimmer import dim_display
from optodrive.daemon.engine.dry_run import DryRunStart
from optodrive.daemon.engine.plan_making import PlanningRequest, make_plan
from optodrive.daemon.engine.planning_snapshot import PlanningSnapshot
from optodrive.daemon.engine.request_body import BuiltRequest, build_request
from optodrive.daemon.engine.thermal_estimate import ThermalEstimate
from optodrive.daemon.push import Push
from optodrive.daemon.responses.plan import PlanReport
from optodrive.daemon.responses.problem import build_error_problem
from optodrive.link.protocol.quantisation import WireScale
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.stimuli.sequence_codec import encode_sequence

DRY_RUN_PLAN = "dry-run"
"""Plan id of every dry run."""


def run_job(display: DisplayModel, scales: Sequence[WireScale], job: Message) -> Message:
    """Do a job and return its result: status and payload, or the status and the document of a problem."""
    try:
        body, start = _split_payload(job)
        push = Push(**job.fields["push"])
        built = build_request(display, job.fields["source"], push.name, body)
        if start is None:
            fields = {"status": 200, "labels": dict(built.labels), "parameters": dict(built.parameters)}
            return Message("result", fields, encode_sequence(built.sequence))
        report = plan_dry_run(display, scales, built, start, push)
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


def plan_dry_run(
    display: DisplayModel, scales: Sequence[WireScale], built: BuiltRequest, start: DryRunStart, push: Push
) -> PlanReport:
    """Plan and prove a sequence without executing it. Raise InputError or RefusedError as the planner does."""
    request = PlanningRequest(lambda: built, push)
    thermal = ThermalEstimate(start.heat, start.budget)
    snapshot = PlanningSnapshot(thermal, start.starts_in_s, start.heat, start.budget)
    dimmed = dim_display(display.without_stage(start.lost_stage), start.power_share)
    plan = make_plan(dimmed, scales, request, built, snapshot, DRY_RUN_PLAN, lambda fraction: None)
    return plan.record.build_report(0.0)
