"""A short sequence that shows what the display can do."""

from dataclasses import replace

from optodrive.core.types.stimuli import FrameSequence
from optodrive.device.config import Config
from optodrive.planning.stimuli.experiments import fingers
from optodrive.planning.stimuli.refresh import end_s
from optodrive.planning.stimuli.shapes import circle, dot
from optodrive.planning.stimuli.text import text_frames

PAUSE_S = 0.3


def showcase(config: Config, where: str) -> FrameSequence:
    """A dot that runs round a ring, the ring, "hello" in braille, two pairs of fingers; about eight seconds.

    Raises InputError on a display too small for a hand.
    """
    return one_after_the_other(
        dot(config, where, radius_m=None, height_m=200e-6, step_s=0.06, turns=1),
        circle(config, where, radius_m=None, height_m=100e-6, seconds=1.5),
        text_frames(config, where, "hello", height_m=150e-6, seconds=2.0),
        fingers(config, where, "2-4", centre=None),
        fingers(config, where, "3-5", centre=None),
    )


def one_after_the_other(*sequences: FrameSequence) -> FrameSequence:
    """Sequences joined in time, with a pause between."""
    joined, start_s = FrameSequence(), 0.0
    for sequence in sequences:
        joined = FrameSequence(
            frames=joined.frames + tuple(replace(f, show_at_s=f.show_at_s + start_s) for f in sequence.frames),
            trains=joined.trains + tuple(replace(t, start_s=t.start_s + start_s) for t in sequence.trains),
        )
        start_s = end_s(joined) + PAUSE_S
    return joined
