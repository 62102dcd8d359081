"""Result of a matching: the participant's sensitivity map, and for a simulated participant how much is left."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.core.files import create_folder
from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.sensitivity_map import SensitivityMap, write_sensitivity_map
from optodrive.study.matching import BOTH_THRESHOLDS
from optodrive.study.session import build_matching_model, list_comparisons
from optodrive.study.study_file import MatchingSection, Study


def write_sensitivity(
    folder: Path,
    study: Study,
    matching: MatchingSection,
    participant: str,
    records: Sequence[dict[str, Any]],
    config: Config,
) -> tuple[Path, SensitivityMap]:
    """Write the sensitivity map of a participant beside the dataset's tables and return it with its path."""
    model = build_matching_model(matching, build_pixel_layout(config.display))
    found = model.estimate(list_comparisons(records))
    sensitivity_map = SensitivityMap(found.sensitivity, found.sigma, participant, len(records))
    path = folder / "derivatives" / f"sub-{participant}_task-{study.task}_sensitivity.toml"
    create_folder(path.parent)
    write_sensitivity_map(path, sensitivity_map, config, {"study": study.name})
    return path, sensitivity_map


def compute_variation(sensitivity: FloatArray, equalised_by: FloatArray | float, intensity: float) -> float:
    """Return the standard deviation over the mean of the intensities felt at all pixels, where one is requested.

    equalised_by: sensitivity by which heights are equalised. Both channels are taken to feel something.
    """
    felt = np.maximum((intensity + BOTH_THRESHOLDS) * sensitivity / equalised_by - BOTH_THRESHOLDS, 0.0)
    return float(felt.std() / felt.mean())
