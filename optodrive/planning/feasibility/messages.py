"""What breaks a plan, and what would fit, in plain sentences."""

from optodrive.core.types.stimuli import FrameSequence
from optodrive.core.units import m_to_um
from optodrive.planning.feasibility.report import NearestFeasible, SequenceReduction
from optodrive.planning.feasibility.violation import Violation
from optodrive.planning.limiter.limiter import PHRASES
from optodrive.planning.planned_sequence import PlannedSequence, describe_lateness


def name_source(sequence: FrameSequence, source: int) -> str:
    """A frame's own name, or a train by its number."""
    frames = sequence.frames
    return frames[source].frame_id if source < len(frames) else f"train {source - len(frames)}"


def describe_violation(sequence: FrameSequence, plan: PlannedSequence | None, violation: Violation) -> str:
    """What breaks a plan first, with its numbers; plan: None where a target is out of reach."""
    frames, name = sequence.frames, name_source(sequence, violation.source)
    is_frame = violation.source < len(frames)
    subject = f"frame {name}" if is_frame else name
    if plan is None:
        target_um = m_to_um(float(frames[violation.source].target_m[violation.pixel]))
        return f"{subject} asks {target_um:.1f} µm of pixel {violation.pixel}, more than the longest pulse reaches"
    if violation.reason != "deadline":
        return f"{subject} asks more of pixel {violation.pixel} than the {PHRASES[violation.reason].rstrip(',')} allows"
    if is_frame:
        return next(describe_lateness(timing) for timing in plan.frames if timing.source == violation.source)
    late_s = float((plan.plan.start_s - plan.plan.requested_start_s)[plan.plan.source == violation.source].max())
    return (
        f"{subject} starts a pulse {late_s * 1e3:.2f} ms late, more than the one move to it takes: "
        f"the moves between trains add up"
    )


def describe_nearest(nearest: NearestFeasible, sequence: FrameSequence, source: int) -> str:
    """The nearest sets in a few words; source: who breaks what was asked."""
    options = []
    if nearest.pixels is not None:
        options.append(_describe_reduction(nearest.pixels, sequence, source))
    if nearest.height_factor is not None:
        options.append(f"heights × {nearest.height_factor:g}")
    if nearest.time_factor is not None:
        options.append(f"times × {nearest.time_factor:g}")
    if options:
        return "nearest that fits: " + ", or ".join(options)
    return "nothing near it fits" if nearest.complete else "nothing near it was found to fit"


def _describe_reduction(reduction: SequenceReduction, sequence: FrameSequence, source: int) -> str:
    is_frame = source < len(sequence.frames)
    is_source_omitted = any(left.source == source for left in reduction.omitted)
    kept_text = (
        f"{reduction.kept} of {reduction.requested} pixels"
        if is_frame or not is_source_omitted
        else f"without {name_source(sequence, source)}"
    )
    others = len(reduction.omitted) - is_source_omitted
    return f"{kept_text} (and less of {others} other{'s' if others > 1 else ''})" if others else kept_text
