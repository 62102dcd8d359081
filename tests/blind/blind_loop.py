"""Does a diagnosis make heights right? A hidden display is driven by plans of the nominal and of the diagnosed model.

Planned by the package, judged by the hidden truth's own integrator. The nominal model knows the display as it would be
without its effect, to the last digit.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from blind_display import respond
from blind_lab import Case
from optodrive.core.types.discrepancy import Discrepancy
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.core.units import ZERO_CELSIUS_K
from optodrive.device.config import load_config
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.diagnosis.model_file import build_model_toml
from optodrive.lab.diagnosis.priors import build_prior
from optodrive.lab.recording import read_recording
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.planned_sequence import PlannedSequence

WIDTH_M = 0.4e-3
SHARES = (0.15, 0.6)
"""Heights asked for, of what both models reach in one pulse."""
AFTER_S = 0.12
STEP_S = 5e-5


@dataclass(frozen=True)
class Loop:
    """Root mean square of (true − asked) / asked over all pulses, and what was said; trimmed: pulses cut by a cap."""

    verdict: str
    said: tuple[str, ...]
    nominal: float
    extended: float
    pulses: int
    trimmed: int

    @property
    def cut(self) -> float:
        """Share of the error that the diagnosed model takes away; the true model takes all of it."""
        return 1.0 - self.extended / self.nominal


def close_loop(case: Case, folder: Path) -> Loop:
    """Diagnose the case, plan the same heights with both models, ask the hidden display what comes out."""
    measurement = read_recording(case.path)
    prior, epsilon, width_m = build_prior(measurement, None)
    found = diagnose(measurement, prior=prior, epsilon=epsilon)
    nominal = replace(found, base=case.base, terms={}, verdict="none", causes=())
    plain = _display(nominal, folder / "nominal.toml", width_m or WIDTH_M)
    extended = _display(found, folder / "model.toml", width_m or WIDTH_M)
    frames = _frames(plain, extended)
    errors, trimmed = [], []
    for display in (plain, extended):
        prepared = plan_sequence(display, frames, *display.build_cold_state())
        trimmed.append(int(np.count_nonzero(prepared.plan.reason != "")))
        errors.append(height_errors(case, display, prepared))
    rms = [float(np.sqrt(np.mean(np.square(item)))) for item in errors]
    return Loop(found.verdict, found.causes, rms[0], rms[1], len(errors[0]), max(trimmed))


def _display(found: Discrepancy, path: Path, width_m: float) -> DisplayModel:
    path.write_text(build_model_toml(found, "blind", width_m))
    config = load_config("display-16")
    display = config.display.model_copy(update={"bridge_width_m": width_m})
    section = config.pixel_model.model_copy(update={"parameters": str(path)})
    return DisplayModel.from_config(config.model_copy(update={"display": display, "pixel_model": section}))


def _frames(*displays: DisplayModel) -> FrameSequence:
    """A ladder of heights over the pixels, and the same upside down while the walls are still warm."""
    reach_m = np.min(
        [display.build_cold_heat().max_displacement_m(display.scan_head.drive).min() for display in displays]
    )
    ladder_m = reach_m * np.linspace(*SHARES, len(displays[0].layout))
    up, down = TactileFrame("up", 0.0, 0.8, ladder_m), TactileFrame("down", 1.2, 0.8, ladder_m[::-1])
    return FrameSequence((up, down), ())


def height_errors(case: Case, display: DisplayModel, prepared: PlannedSequence) -> np.ndarray:
    """(true − asked) / asked of every pulse [n], true by the hidden display as the session left it."""
    plan = prepared.plan
    pulses = np.column_stack([plan.start_s, plan.width_s, plan.power_w, plan.pixel])
    ambient_k = display.config.ambient_c + ZERO_CELSIUS_K
    dose_j = case.truth.ageing_dose if case.truth.ageing else 0.0
    errors = np.zeros(len(plan))
    for pixel in np.unique(plan.pixel).tolist():
        rows = np.flatnonzero(plan.pixel == pixel)
        own = pulses[rows]
        t_s = np.arange(0.0, own[-1, 0] + own[-1, 1] + AFTER_S, STEP_S)
        told = respond(case.truth, own, {"displacement_m": t_s}, pixel=pixel, ambient_k=ambient_k, dose_j=dose_j)
        z_m = told["displacement_m"]
        for place, row in enumerate(rows):
            until_s = own[place + 1, 0] if place + 1 < len(rows) else np.inf
            during = (t_s >= own[place, 0]) & (t_s < until_s)
            errors[row] = z_m[during].max() / plan.target_m[row] - 1.0
    return errors
