"""Commands that a user runs next after the findings of a diagnosis."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import join

from optodrive.core.quantity import format_quantity
from optodrive.core.types.discrepancy import Discrepancy
from optodrive.physics.terms import discover_terms

FRAMES = "frames.json"
OUT = "answer"
"""Folder of the answer, where no other is named."""


@dataclass(frozen=True)
class NextStep:
    """A reason, and the command to run for it, from the folder in which the diagnosis was run."""

    reason: str
    command: str


def list_next_steps(
    discrepancy: Discrepancy, recordings: Sequence[str], out: str = OUT, config: str | None = None
) -> list[NextStep]:
    """Return the steps in their order.

    recordings, out, config: what was diagnosed, the answer's folder and the configuration, as the command named them
    """
    display = () if config is None else ("--config", config)
    model = str(Path(out) / "model.toml")
    steps = [_inspect_term(label) for label in discrepancy.failures]
    if discrepancy.verdict == "unexplained":
        show = ("recording", "show", recordings[0], "--out", "signals.png")
        steps.append(_step("Look at the signals in which the residuals are largest.", *show))
    if discrepancy.verdict in ("ambiguous", "undecided") or discrepancy.doubts:
        again = (
            "Record the proposed experiment" if discrepancy.next_experiment else "Record each experiment three times"
        )
        more = ("diagnose", *recordings, "more.h5", "--out", f"{out.rstrip('/')}-2", *display)
        steps.append(_step(f"{again}, and diagnose it together with these runs.", *more))
    if "mirror_lag" in discrepancy.causes:
        steps.append(
            _step("Identify the mirrors' servos from steps.", "calibrate", "steps", "--out", "steps", *display)
        )
        servo = ("calibrate", "servo", "steps", "--out", "mirrors.toml", *display)
        steps.append(_step("Complete the steps by the measured angles; plan with the result (--mirrors).", *servo))
    if "clock_offset" in discrepancy.causes:
        steps.append(_correct_clock(discrepancy, recordings, out, display))
    changes_plans = any(_changes_plans(key) for key in discrepancy.causes)
    is_nominal = discrepancy.verdict in ("none", "instrument")
    if discrepancy.base and discrepancy.verdict != "unexplained" and (changes_plans or is_nominal):
        steps.append(_step("Plan heights with this model.", "plan", FRAMES, "--model", model, *display))
        if changes_plans:
            simulate = ("simulate", FRAMES, "--truth", model, *display)
            steps.append(_step("See what the effect does to heights planned without it.", *simulate))
        steps.append(_step("Serve the display with it.", "serve", "--model", model, *display))
    return steps


def _changes_plans(key: str) -> bool:
    """Return whether a term acts in the pixel, rather than in an instrument or in the mirrors."""
    kernels = discover_terms()[key].kernels._replace(sensor_reading=None, sensor_lag=None, force=None)
    return any(hook is not None for hook in kernels)


def _correct_clock(discrepancy: Discrepancy, recordings: Sequence[str], out: str, display: Sequence[str]) -> NextStep:
    """Return the step that corrects the times of all signals when they are merged, or of one before it is."""
    offsets = {name: item.value for name, item in discrepancy.parameters.items() if name.startswith("clock_offset.")}
    if len(offsets) > 1:
        offset_s = next(iter(offsets.values()))
        files = ("session.h5", "measured", f"--time-offset={-offset_s:.3g}", "--out", "recording.h5")
        return _step(
            "Correct the instrument's times when session and measurement are merged.", "recording", "merge", *files
        )
    name, offset_s = next(iter(offsets.items()))
    reason = f"Correct the times of {name.partition('.')[2]} by {format_quantity(-offset_s, 's')}, and diagnose again."
    return _step(reason, "diagnose", *recordings, "--out", f"{out.rstrip('/')}-2", *display)


def _inspect_term(label: str) -> NextStep:
    key = label.partition(" ")[0].rstrip(":")
    return _step(f"Correct the term, which could not be computed: {key}.", "terms", key)


def _step(reason: str, *arguments: str) -> NextStep:
    return NextStep(reason, join(["optodrive", *arguments]))
