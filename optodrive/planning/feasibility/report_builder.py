"""The answer made up of what was found."""

from optodrive.core.types.stimuli import FrameSequence
from optodrive.planning.feasibility.bulk_reduction import OmittedPixels
from optodrive.planning.feasibility.messages import describe_nearest, describe_violation, name_source
from optodrive.planning.feasibility.report import (
    FeasibilityReport,
    FitMode,
    NearestFeasible,
    Omission,
    Proof,
    SequenceReduction,
)
from optodrive.planning.feasibility.violation import Violation
from optodrive.planning.planned_sequence import PlannedSequence


def build_feasible_report(plan: PlannedSequence, proof: Proof, fit: FitMode) -> FeasibilityReport:
    """The answer for a plan that fits."""
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
        message="all of it fits" if proof == "planned" else "all of it fits, in another order than the planner's own",
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
    """The answer for a sequence that does not fit; plan: None where a target is out of reach."""
    required_s, available_s = (None, None) if plan is None else _beam_times_s(plan, violation)
    parts = [
        describe_violation(sequence, plan, violation),
        _PROOF_MESSAGES[proof],
        describe_nearest(nearest, sequence, violation.source),
    ]
    if proof == "bound" and lower_bound_s is not None:
        parts[1] = f"in any order it takes {lower_bound_s:.4f} s at the least"
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
    "bound": "no order mends that",
    "not found": "no order that fits is known, which does not prove that there is none",
}


def _beam_times_s(plan: PlannedSequence, violation: Violation) -> tuple[float, float]:
    """Beam time needed and there of the frame that breaks, or of a train's pulse from its nominal time."""
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
    """What is left out of a sequence, and how much is kept of a source."""

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
