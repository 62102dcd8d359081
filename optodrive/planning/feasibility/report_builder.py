"""Build feasibility reports from plans, violations and variants."""

from optodrive.core.types.push_options import FitMode
from optodrive.core.types.stimuli import FrameSequence
from optodrive.planning.feasibility.bulk_reduction import OmittedPixels
from optodrive.planning.feasibility.messages import describe_nearest, describe_violation, name_source
from optodrive.planning.feasibility.report import (
    FeasibilityReport,
    NearestFeasible,
    Omission,
    Proof,
    SequenceReduction,
)
from optodrive.planning.feasibility.violation import Violation
from optodrive.planning.planned_sequence import PlannedSequence


def build_feasible_report(plan: PlannedSequence, proof: Proof, fit: FitMode) -> FeasibilityReport:
    """Build the report of a plan that fits."""
    end_s = [timing.deadline_s for timing in plan.frames]
    if len(plan.plan):
        end_s.append(
            float(
                (plan.plan.requested_start_s + plan.plan.width_s)[plan.plan.source >= len(plan.sequence.frames)].max(
                    initial=0.0
                )
            )
        )
    return FeasibilityReport(
        fits=True,
        proof=proof,
        message="all of it fits" if proof == "planned" else "all of it fits, in another order than the planner's",
        beam_required_s=float(plan.plan.width_s.sum() + plan.plan.settling_s[1:].sum()),
        beam_available_s=max(0.0, max(end_s, default=0.0) - plan.lead_in_s),
        fit=fit,
    )


def build_infeasible_report(
    sequence: FrameSequence,
    plan: PlannedSequence | None,
    violation: Violation,
    proof: Proof,
    lower_bound_s: float | None,
    nearest: NearestFeasible,
) -> FeasibilityReport:
    """Build the report of a sequence that does not fit. The plan is None if a target is unreachable."""
    required_s, available_s = (None, None) if plan is None else _beam_times_s(plan, violation)
    parts = [
        describe_violation(sequence, plan, violation),
        _PROOF_MESSAGES[proof],
        describe_nearest(nearest, sequence, violation.source),
    ]
    if proof == "bound" and lower_bound_s is not None:
        parts[1] = f"in any order it takes at least {lower_bound_s:.4f} s"
    return FeasibilityReport(
        fits=False,
        proof=proof,
        message="; ".join(part for part in parts if part),
        reason=violation.reason,
        name=name_source(sequence, violation.source),
        pixel=violation.pixel,
        beam_required_s=required_s,
        beam_available_s=available_s,
        beam_lower_bound_s=lower_bound_s,
        nearest=nearest,
    )


_PROOF_MESSAGES: dict[Proof, str] = {
    "planned": "",
    "searched": "no other order fits",
    "bound": "no other order can fit",
    "not found": "no order that fits was found, which does not prove that none exists",
}


def _beam_times_s(plan: PlannedSequence, violation: Violation) -> tuple[float, float]:
    """Return the required and the available beam time in s of the frame, or of the train's pulse, in violation."""
    for timing in plan.frames:
        if timing.source == violation.source:
            return timing.end_s - timing.show_at_s, timing.deadline_s - timing.show_at_s
    pulses = plan.plan
    is_source = pulses.source == violation.source
    late_s = (pulses.start_s - pulses.requested_start_s - pulses.settling_s)[is_source]
    row = is_source.nonzero()[0][int((late_s > 0).argmax())]
    width_s = float(pulses.width_s[row])
    return width_s + float(pulses.start_s[row] - pulses.requested_start_s[row]), width_s + float(pulses.settling_s[row])


def build_reduction(sequence: FrameSequence, omitted_pixels: OmittedPixels, source: int) -> SequenceReduction:
    """Describe the omitted pixels by name.

    source: the frame or train whose pixels are counted
    """

    def count_requested(index: int) -> int:
        frames = sequence.frames
        return int((frames[index].target_m > 0).sum()) if index < len(frames) else 1

    omitted = tuple(
        Omission(name_source(sequence, index), index, tuple(sorted(pixels)))
        for index, pixels in sorted(omitted_pixels.items())
        if pixels
    )
    return SequenceReduction(
        count_requested(source) - len(omitted_pixels.get(source, ())), count_requested(source), omitted
    )
