"""A short sequence that demonstrates the display."""

from dataclasses import replace

from optodrive.core.types.stimuli import FrameSequence
from optodrive.device.config import Config
from optodrive.planning.stimuli.experiments import build_two_fingers
from optodrive.planning.stimuli.refresh import sequence_end_s
from optodrive.planning.stimuli.shapes import build_moving_dot, build_ring
from optodrive.planning.stimuli.text import build_text

PAUSE_S = 0.3
"""Pause between two parts, s."""


def build_showcase(config: Config, where: str) -> FrameSequence:
    """Build a dot along a ring, the ring, "hello" in braille, and two pairs of fingers, in about eight seconds.

    Raises InputError (does_not_fit) on a display too small for a hand.
    """
    return concatenate_sequences(
        build_moving_dot(config, where, radius_m=None, height_m=200e-6, step_s=0.06, turns=1),
        build_ring(config, where, radius_m=None, height_m=100e-6, seconds=1.5),
        build_text(config, where, "hello", height_m=150e-6, seconds=2.0),
        build_two_fingers(config, where, "2-4", centre=None),
        build_two_fingers(config, where, "3-5", centre=None),
    )


def concatenate_sequences(*sequences: FrameSequence) -> FrameSequence:
    """Concatenate sequences in time, with a pause between them."""
    concatenated, start_s = FrameSequence(), 0.0
    for sequence in sequences:
        concatenated = FrameSequence(
            frames=concatenated.frames + tuple(replace(f, show_at_s=f.show_at_s + start_s) for f in sequence.frames),
            trains=concatenated.trains + tuple(replace(t, start_s=t.start_s + start_s) for t in sequence.trains),
        )
        start_s = sequence_end_s(concatenated) + PAUSE_S
    return concatenated
