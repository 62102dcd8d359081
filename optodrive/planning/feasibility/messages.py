"""One-line messages about the first violation and the nearest feasible variants."""

from optodrive.core.quantity import format_quantity, m_to_um
from optodrive.core.types.stimuli import FrameSequence
from optodrive.planning.feasibility.report import NearestFeasible, SequenceReduction
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
