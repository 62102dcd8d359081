"""What breaks a plan, and what would fit, in plain sentences."""

from optodrive.core.types.stimuli import FrameSequence
from optodrive.core.units import m_to_um
from optodrive.planning.feasibility.report import Nearest, Thinned
from optodrive.planning.feasibility.violation import Breach
from optodrive.planning.limiter.limiter import PHRASES
from optodrive.planning.pipeline import Prepared, lateness


def source_name(sequence: FrameSequence, source: int) -> str:
    """A frame's own name, or a train by its number."""
    frames = sequence.frames
    return frames[source].frame_id if source < len(frames) else f"train {source - len(frames)}"


def sentence(sequence: FrameSequence, plan: Prepared | None, breach: Breach) -> str:
    """What breaks a plan first, with its numbers; plan: None where a target is out of reach."""
    frames, name = sequence.frames, source_name(sequence, breach.source)
    of_frame = breach.source < len(frames)
    called = f"frame {name}" if of_frame else name
    if plan is None:
        target_um = m_to_um(float(frames[breach.source].target_m[breach.pixel]))
        return f"{called} asks {target_um:.1f} µm of pixel {breach.pixel}, more than the longest pulse reaches"
    if breach.reason != "deadline":
        return f"{called} asks more of pixel {breach.pixel} than the {PHRASES[breach.reason].rstrip(',')} allows"
    if of_frame:
        return next(lateness(timing) for timing in plan.frames if timing.source == breach.source)
    late_s = float((plan.plan.start_s - plan.plan.nominal_s)[plan.plan.source == breach.source].max())
    return (
        f"{called} starts a pulse {late_s * 1e3:.2f} ms late, more than the one move to it takes: "
        f"the moves between trains add up"
    )


def suggestion(nearest: Nearest, sequence: FrameSequence, source: int) -> str:
    """The nearest sets in a few words; source: who breaks what was asked."""
    ways = []
    if nearest.pixels is not None:
        ways.append(_fewer(nearest.pixels, sequence, source))
    if nearest.height is not None:
        ways.append(f"heights × {nearest.height:g}")
    if nearest.rate is not None:
        ways.append(f"times × {nearest.rate:g}")
    if ways:
        return "nearest that fits: " + ", or ".join(ways)
    return "nothing near it fits" if nearest.complete else "nothing near it was found to fit"


def _fewer(thinned: Thinned, sequence: FrameSequence, source: int) -> str:
    of_frame = source < len(sequence.frames)
    own = any(left.source == source for left in thinned.left_out)
    what = (
        f"{thinned.kept} of {thinned.asked} pixels"
        if of_frame or not own
        else f"without {source_name(sequence, source)}"
    )
    others = len(thinned.left_out) - own
    return f"{what} (and less of {others} other{'s' if others > 1 else ''})" if others else what
