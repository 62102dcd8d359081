"""Ground truth of a simulated display: a parameter set with its terms, and pixels that may deviate."""

from pathlib import Path

from optodrive.core.errors import InputError
from optodrive.device.config import Config
from optodrive.device.pixel_map import remove_pixel_map
from optodrive.link.simulator.true_pixels import GroundTruthPixels
from optodrive.physics.parameters import build_display_pixels, list_own_terms, load_parameters
from optodrive.physics.terms import all_terms
from optodrive.physics.thermal_state import ThermalState, build_cold_state


def select_true_terms(config: Config, truth: Path | None) -> tuple[list[str], list[str]]:
    """Return the terms of the ground truth, and those of its parameter set that are left out.

    The truth has the planner terms and every term that its file states. Raises InputError for a term that the file
    states and that only the limiter accounts for.
    """
    parameters = load_parameters(config.pixel_model.parameters)
    own = () if truth is None or truth.suffix != ".toml" else list_own_terms(truth)
    for key in own:
        if not all_terms()[key].in_pixel:
            expected = "terms that pixels are simulated with; only the limiter accounts for this one"
            raise InputError(f"--truth {truth}: terms.{key}", key, expected)
    selected = list(dict.fromkeys((*parameters.planner_terms, *own)))
    return selected, [key for key in parameters.term_keys if key not in selected]


def build_true_display(config: Config, sampled_pixels: GroundTruthPixels | None, true_terms: list[str]) -> ThermalState:
    """Build the ground truth of the display: the configured model with sampled or equal pixels, without a pixel map."""
    parameters = load_parameters(config.pixel_model.parameters)
    parameters = parameters.model_copy(update={"planner_terms": tuple(true_terms)})
    nominal_pixels = build_display_pixels(remove_pixel_map(config), parameters)
    return build_cold_state(
        config, parameters, nominal_pixels if sampled_pixels is None else sampled_pixels.apply_to(nominal_pixels)
    )
