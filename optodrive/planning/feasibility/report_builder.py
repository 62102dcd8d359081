"""Build feasibility reports from plans, violations and variants, with one-line messages on the first violation."""

from optodrive.core.quantity import format_quantity, m_to_um
from optodrive.core.types.push_options import FitMode
from optodrive.core.types.stimuli import FrameSequence
from optodrive.planning.feasibility.reduction import OmittedPixels
from optodrive.planning.feasibility.report import (
    FeasibilityReport,
    NearestFeasible,
    Omission,
    Proof,
    SequenceReduction,
)
from optodrive.planning.feasibility.violation import Violation
from optodrive.planning.limiter.caps import CAPS_BY_KEY
from optodrive.planning.planned_sequence import PlannedSequence, describe_lateness


def name_source(sequence: FrameSequence, source: int) -> str:
    """Return the identifier of a frame, or the number of a train."""
    frames = sequence.frames
    return frames[source].frame_id if source < len(frames) else f"train {source - len(frames)}"


def describe_violation(sequence: FrameSequence, plan: PlannedSequence | None, violation: Violation) -> str:
    """Describe the first violation with its numbers. The plan is None if a target is unreachable."""
    frames, name = sequence.frames, name_source(sequence, violation.source)
    is_frame = violation.source < len(frames)
    subject = f"frame {name}" if is_frame else name
    if plan is None:
        target_um = m_to_um(float(frames[violation.source].target_m[violation.pixel]))
        return f"{subject} requests {target_um:.1f} µm at pixel {violation.pixel}, more than the longest pulse reaches"
    if violation.reason != "deadline":
        cap = CAPS_BY_KEY[violation.reason].message
        return f"{subject} requests more at pixel {violation.pixel} than the {cap} allows"
    if is_frame:
        return next(describe_lateness(timing) for timing in plan.frames if timing.source == violation.source)
    late_s = float((plan.plan.start_s - plan.plan.requested_start_s)[plan.plan.source == violation.source].max())
    return (
        f"{subject} starts a pulse {format_quantity(late_s, 's')} late, more than one settling time: "
        f"the settling times between trains add up"
    )


def describe_nearest(nearest: NearestFeasible, sequence: FrameSequence, source: int) -> str:
    """Describe the nearest feasible variants.

    source: the frame or train of the violation
    """
    options = []
    if nearest.pixels is not None:
        options.append(_describe_reduction(nearest.pixels, sequence, source))
    if nearest.height_factor is not None:
        options.append(f"heights × {nearest.height_factor:g}")
    if nearest.time_factor is not None:
        options.append(f"times × {nearest.time_factor:g}")
    if options:
        return "nearest feasible: " + ", or ".join(options)
    return "no variant fits" if nearest.complete else "no variant was found to fit"


def _describe_reduction(reduction: SequenceReduction, sequence: FrameSequence, source: int) -> str:
    """Describe which pixels or trains a reduction keeps and how many other sources it reduces."""
    is_frame = source < len(sequence.frames)
    is_source_omitted = any(item.source == source for item in reduction.omitted)
    kept_text = (
        f"{reduction.kept} of {reduction.requested} pixels"
        if is_frame or not is_source_omitted
        else f"without {name_source(sequence, source)}"
    )
    others = len(reduction.omitted) - is_source_omitted
    return f"{kept_text} (and less of {others} other{'s' if others > 1 else ''})" if others else kept_text


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
