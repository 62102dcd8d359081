"""Checks of a sequence against the display before it is planned: reachable targets, dead pixels."""

from dataclasses import replace

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.quantity import format_quantity, m_to_um
from optodrive.core.types.stimuli import FrameSequence
from optodrive.planning.display_model import DisplayModel


def first_unreachable(display: DisplayModel, sequence: FrameSequence) -> tuple[int, int, float] | None:
    """Find the first target that the longest pulse at full power does not reach on a cold display.

    Returns the frame's index, the pixel and the displacement that the pixel reaches, m; None if all are reachable.
    """
    for source, frame in enumerate(sequence.frames):
        unreachable = np.flatnonzero(frame.target_m > display.max_displacement_m)
        if len(unreachable):
            return source, int(unreachable[0]), float(display.max_displacement_m[unreachable[0]])
    return None


def check_targets_reachable(display: DisplayModel, sequence: FrameSequence) -> None:
    """Raise InputError (target_unreachable) for the first target that no single pulse reaches on a cold display."""
    unreachable = first_unreachable(display, sequence)
    if unreachable is None:
        return
    source, pixel, max_m = unreachable
    frame, laser, limits = sequence.frames[source], display.config.laser, display.config.limits
    within = " within the range of a discovered term's data" if display.parameters.discovered else ""
    raise InputError(
        f"frame {frame.frame_id}: target_um of pixel {pixel}",
        round(m_to_um(float(frame.target_m[pixel])), 3),
        f"at most {m_to_um(max_m):.0f} µm, the reach of the longest pulse "
        f"({format_quantity(limits.pulse_width_max_s, 's')} at {format_quantity(laser.max_power_w, 'W')}){within}",
        code="target_unreachable",
    )


def remove_dead_pixels(display: DisplayModel, sequence: FrameSequence) -> tuple[FrameSequence, tuple[int, ...]]:
    """Return the sequence without dead pixels in its frames, and the dead pixels that were requested.

    Raises InputError (dead_pixel) for a train on a dead pixel, because a train has no other pixel.
    """
    if not display.dead.any():
        return sequence, ()
    for index, train in enumerate(sequence.trains):
        if display.dead[train.pixel]:
            raise InputError(f"trains[{index}].pixel", train.pixel, "a live pixel: this one is dead", "dead_pixel")
    requested = np.zeros(len(display.dead), dtype=np.bool_)
    for frame in sequence.frames:
        requested |= frame.target_m > 0
    dead = np.flatnonzero(requested & display.dead)
    if not len(dead):
        return sequence, ()
    frames = tuple(replace(frame, target_m=np.where(display.dead, 0.0, frame.target_m)) for frame in sequence.frames)
    return replace(sequence, frames=frames), tuple(dead.tolist())
