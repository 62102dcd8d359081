"""Height errors of plans made with the nominal and with the diagnosed model, on a hidden display.

The package plans and the ground truth's own integrator judges. The nominal model has the exact parameters of the
display without its effect.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from blind_display import simulate_signals
from blind_lab import Case
from optodrive.core.quantity import ZERO_CELSIUS_K
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config_file import load_config
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.diagnosis.narrative import build_model_toml
from optodrive.lab.diagnosis.nominal_fit import build_prior
from optodrive.lab.pixel_discovery import discover_in_pixel
from optodrive.lab.pixel_discovery.planned_terms import build_planned_terms
from optodrive.lab.recording import read_recording
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.planned_sequence import PlannedSequence

WIDTH_M = 0.4e-3
HEIGHT_SHARES = (0.15, 0.6)
"""Target heights as shares of the displacement that both models reach in one pulse."""
AFTER_S = 0.12
STEP_S = 5e-5


@dataclass(frozen=True)
class LoopResult:
    """RMS of (true − target) / target over all pulses, and the diagnosis, or where a discovery found which function.

    trimmed: pulses trimmed by a cap
    """

    verdict: str
    causes: tuple[str, ...]
    nominal: float
    extended: float
    pulses: int
    trimmed: int

    @property
    def error_reduction(self) -> float:
        """Share of the error that the diagnosed model removes. The true model removes all of it."""
        return 1.0 - self.extended / self.nominal


def close_loop(case: Case, folder: Path) -> LoopResult:
    """Diagnose the case, plan the same heights with both models, and compute their errors on the hidden display."""
    measurement = read_recording(case.path)
    prior, width_m = build_prior(measurement, None)
    found = diagnose(measurement, prior=prior)
    model = build_model_toml(found.base, found.terms, found.verdict, "blind", width_m or WIDTH_M)
    return _compare_plans(case, folder, found.verdict, found.causes, model, width_m or WIDTH_M)


def close_discovery_loop(case: Case, folder: Path) -> LoopResult | None:
    """Do the same with what a discovery finds. Return None if heights cannot be planned with it."""
    measurement = read_recording(case.path)
    prior, width_m = build_prior(measurement, None)
    planned = build_planned_terms(discover_in_pixel(measurement, prior))
    if not planned.terms:
        return None
    width_m = width_m or WIDTH_M
    model = build_model_toml(planned.base, {}, "unexplained", "blind", width_m, discovered=planned.terms)
    places = tuple(f"{term.where} by {term.depends_on}" for term in planned.terms)
    return _compare_plans(case, folder, "unexplained", places, model, width_m)


def _compare_plans(
    case: Case, folder: Path, verdict: str, causes: tuple[str, ...], model: str, width_m: float
) -> LoopResult:
    """Return the errors of heights planned with the true nominal model, and with what was found.

    model: text of its parameter file
    """
    plain = _load_display(build_model_toml(case.base, {}, "none", "blind", width_m), folder / "nominal.toml", width_m)
    extended = _load_display(model, folder / "model.toml", width_m)
    frames = _build_sequence(plain, extended)
    errors, trimmed = [], []
    for display in (plain, extended):
        prepared = plan_sequence(display, frames, *display.build_cold_state())
        trimmed.append(int(np.count_nonzero(prepared.plan.reason != "")))
        errors.append(compute_height_errors(case, display, prepared))
    rms = [float(np.sqrt(np.mean(np.square(item)))) for item in errors]
    return LoopResult(verdict, causes, rms[0], rms[1], len(errors[0]), max(trimmed))


def _load_display(model: str, path: Path, width_m: float) -> DisplayModel:
    path.write_text(model)
    config = load_config("display-16")
    display = config.display.model_copy(update={"bridge_width_m": width_m})
    section = config.pixel_model.model_copy(update={"parameters": str(path)})
    return DisplayModel.from_config(config.model_copy(update={"display": display, "pixel_model": section}))


def _build_sequence(*displays: DisplayModel) -> FrameSequence:
    """Return a ladder of heights over the pixels, and the reverse ladder while the walls are still warm."""
    max_displacement_m = np.min(
        [display.build_cold_heat().max_displacement_m(display.scan_head.drive).min() for display in displays]
    )
    ladder_m = max_displacement_m * np.linspace(*HEIGHT_SHARES, len(displays[0].layout))
    up, down = TactileFrame("up", 0.0, 0.8, ladder_m), TactileFrame("down", 1.2, 0.8, ladder_m[::-1])
    return FrameSequence((up, down), ())


def compute_height_errors(case: Case, display: DisplayModel, prepared: PlannedSequence) -> np.ndarray:
    """Return (true − target) / target of every pulse [n] on the hidden display as the session left it."""
    plan = prepared.plan
    pulses = np.column_stack([plan.start_s, plan.width_s, plan.power_w, plan.pixel])
    ambient_k = display.config.ambient_c + ZERO_CELSIUS_K
    dose_j = case.truth.ageing_dose if case.truth.ageing else 0.0
    errors = np.zeros(len(plan))
    for pixel in np.unique(plan.pixel).tolist():
        rows = np.flatnonzero(plan.pixel == pixel)
        own = pulses[rows]
        t_s = np.arange(0.0, own[-1, 0] + own[-1, 1] + AFTER_S, STEP_S)
        signals = simulate_signals(
            case.truth, own, {"displacement_m": t_s}, pixel=pixel, ambient_k=ambient_k, dose_j=dose_j
        )
        z_m = signals["displacement_m"]
        for place, row in enumerate(rows):
            until_s = own[place + 1, 0] if place + 1 < len(rows) else np.inf
            during = (t_s >= own[place, 0]) & (t_s < until_s)
            errors[row] = z_m[during].max() / plan.target_m[row] - 1.0
    return errors
