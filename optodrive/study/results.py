"""Results of a study: accuracy with its binomial interval, the line of magnitude estimates, and sensitivity maps.

For a simulated participant a map states how much is left.
"""

from collections.abc import Callable, Mapping, Sequence
from math import log
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from optodrive.core.files import create_folder
from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.sensitivity_map import SensitivityMap, write_sensitivity_map
from optodrive.study.matching import BOTH_THRESHOLDS
from optodrive.study.session import build_matching_model, build_threshold_model, list_answered, list_comparisons
from optodrive.study.study_file import Study
from optodrive.study.study_sections import MatchingSection, Value
from optodrive.study.threshold import sum_binomial

CONFIDENCE = 0.95
BISECTIONS = 60


class Interval(NamedTuple):
    """Interval of a share."""

    low: float
    high: float

    def contains(self, share: float) -> bool:
        """Return whether a share lies within."""
        return self.low <= share <= self.high


class Accuracy(NamedTuple):
    """Correct answers of a number of trials."""

    correct: int
    trials: int

    @property
    def share(self) -> float:
        """Share of correct answers."""
        return self.correct / self.trials

    @property
    def interval(self) -> Interval:
        """Exact 95 % interval of the probability of a correct answer (Clopper and Pearson 1934)."""
        tail, k, n = (1.0 - CONFIDENCE) / 2.0, self.correct, self.trials
        low = 0.0 if k == 0 else _bisect(lambda p: 1.0 - sum_binomial(k - 1, n, p) - tail)
        high = 1.0 if k == n else _bisect(lambda p: tail - sum_binomial(k, n, p))
        return Interval(low, high)


class Line(NamedTuple):
    """Regression of magnitudes on a factor: slope, intercept, and r² of the means and of the participants' values."""

    slope: float
    intercept: float
    r_squared: float
    participants_r_squared: float


def count_correct(records: Sequence[dict[str, Any]]) -> Accuracy:
    """Count the correct answers of the trials that have a correct answer and are no catch trials."""
    judged = [record for record in records if record["is_correct"] is not None and not record["is_catch"]]
    return Accuracy(sum(record["is_correct"] for record in judged), len(judged))


def list_thresholds(study: Study, sessions: Mapping[str, Sequence[dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """Return the threshold, or the equality, of each session and block of a study with levels by their names."""
    found: dict[str, dict[str, Any]] = {}
    blocks = study.block_list
    is_equality = study.procedure is not None and study.procedure.equal_interval is not None
    for name, records in sessions.items():
        for block in blocks:
            answered = list_answered(study, [record for record in records if record["block"] == block.name])
            key = name if len(blocks) == 1 else f"{name} {block.name}"
            if is_equality:
                found[key] = find_equality(study.threshold_levels, answered)
            else:
                found[key] = build_threshold_model(study).estimate(answered)._asdict()
    return found


def find_equality(levels: Sequence[float], answered: Sequence[tuple[int, bool]]) -> dict[str, Any]:
    """Return the geometric mean of the levels at the reversals after the first two, and the number of reversals."""
    turns = [k for k in range(1, len(answered)) if answered[k][1] != answered[k - 1][1]]
    used = [log(levels[answered[k][0]]) for k in turns[2:]] or [log(levels[level]) for level, _ in answered[-1:]]
    return {"equality": float(np.exp(np.mean(used))) if used else float("nan"), "reversals": len(turns)}


def fit_magnitudes(study: Study, sessions: Sequence[Sequence[dict[str, Any]]]) -> Line:
    """Fit a line to the magnitudes of participants over the study's first factor.

    As in Text S5: the geometric mean of a participant's answers per level, divided by the grand geometric mean.
    """
    factor, levels = next(iter(study.factors.items()))
    means = np.array([[_geometric_mean(records, factor, level) for level in levels] for records in sessions])
    values = means / np.exp(np.log(means).mean(axis=1, keepdims=True))
    x = np.array([float(level) for level in levels])
    mean = values.mean(axis=0)
    slope, intercept = np.polyfit(x, mean, 1)
    fitted = slope * x + intercept
    return Line(float(slope), float(intercept), _explained(mean, fitted), _explained(values, fitted[None, :]))


def _geometric_mean(records: Sequence[dict[str, Any]], factor: str, level: Value) -> float:
    return float(np.exp(np.mean([log(record["answer"]) for record in records if record["condition"][factor] == level])))


def _explained(values: Any, fitted: Any) -> float:
    return 1.0 - float(np.sum((values - fitted) ** 2) / np.sum((values - values.mean()) ** 2))


def _bisect(function: Callable[[float], float]) -> float:
    """Return the root of a function that increases on 0 to 1."""
    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if function(middle) < 0.0 else (low, middle)
    return 0.5 * (low + high)


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
