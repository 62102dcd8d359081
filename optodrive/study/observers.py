"""Simulated participants: how an observer with a channel model, an unsure sense of place and lapses answers.

Theory of operation. A participant perceives from the executed pulses, never from the request. Two numbers are fitted to
the paper's accuracies; everything else is from the literature or from the geometry:

- `localisation_sd_m`: standard deviation, per axis, of the perceived place of a pixel stimulated for 0.5 s. A place
  that is stimulated for another time t has sqrt(0.5 s / t) times that, as an average over independent samples has. Its
  time ends when the next place begins, or 100 ms after its last pulse (persistence and backward masking).
- `lapse`: share of trials in which the answer is a guess.

Linear motion is the mean step from the first to the last place. Rotation is the sign of the area that the perceived
path encloses. A localisation is the nearest of the places. The odd one of three is the one whose channel signals
(`sensation`) differ most from those of the others, with a Weber fraction of 0.2 (Craig 1972; Forta et al. 2012 find
0.2 to 0.6). A magnitude is the perceived intensity with noise of the same kind, and so are the two that are compared.
Fingers are not confused.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.device.config import PixelLayout
from optodrive.physics.sensation import PERSISTENCE_S, ChannelSignals, compute_pulse_excitations, compute_signals
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.stimuli.experiments import compute_finger_places
from optodrive.planning.stimuli.pixel_lattice import Lattice
from optodrive.study.presenter import Presentation
from optodrive.study.study_file import Study

REFERENCE_S = 0.5
WEBER_FRACTION = 0.2
DETECTION_SLOPE = 3.0
"""Slope of the Weibull function of detection over the amplitude; some 3 for vibration."""
STIMULUS_PAUSE_S = 0.2
"""Pause without a pulse that separates two stimuli on one pixel."""
MAGNITUDE_BOUNDS = (0.01, 0.99)
FULL_SCALE = 1.25
"""End of the scale of magnitudes, as a factor of the intensity at the highest power."""


@dataclass(frozen=True)
class Participant:
    """A simulated participant. The defaults are fitted to the paper (docs/explanation/perception.md)."""

    localisation_sd_m: float = 1.35e-3
    lapse: float = 0.025


def draw_sensitivity(layout: PixelLayout, sensitivity_range: float, rng: np.random.Generator) -> FloatArray:
    """Draw the sensitivity of a participant at each pixel, [p]: a slope and a bump, of mean logarithm 0.

    sensitivity_range: largest over smallest sensitivity
    """
    if sensitivity_range == 1.0 or len(layout) < 2:
        return np.ones(len(layout))
    position = np.column_stack([layout.x_m, layout.y_m])
    position = position / np.abs(position).max()
    angle, bump = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.7, 0.7, 2)
    height = position @ (np.cos(angle), np.sin(angle))
    height = height + rng.normal() * 2.0 * np.exp(-2.0 * np.sum((position - bump) ** 2, axis=1))
    logarithm = np.log(sensitivity_range) * height / np.ptp(height)
    return np.asarray(np.exp(logarithm - logarithm.mean()), dtype=np.float64)


class Visits(NamedTuple):
    """Places in the order of stimulation: pixel [n], position_m [n, 2] in x and y, exposure_s [n]."""

    pixel: list[int]
    position_m: FloatArray
    exposure_s: FloatArray


class Observer:
    """Answers of one simulated participant in a study.

    sensitivity: [p] factor of the felt displacement by pixel, 1 by default
    """

    def __init__(
        self, study: Study, display: DisplayModel, participant: Participant, sensitivity: FloatArray | None = None
    ) -> None:
        if study.simulation is None:
            raise ValueError(f"study {study.name} states no observer")
        self._study, self._display, self._participant = study, display, participant
        self._layout, self._lattice = display.layout, Lattice.from_config(display.config)
        self._sensitivity = np.ones(len(display.layout)) if sensitivity is None else sensitivity
        self._pitch_m = display.config.display.pitch_m
        rules: dict[str, Callable[[Presentation, np.random.Generator], str | float]] = {
            "linear-motion": self._judge_linear_motion,
            "rotation": self._judge_rotation,
            "localisation": self._locate,
            "intensity": self._rate,
            "oddball": self._find_odd,
            "digits": self._name_digits,
            "detection": self._detect,
            "comparison": self._compare,
        }
        self._perceive = rules[study.simulation.observer]

    def answer(self, shown: Presentation, rng: np.random.Generator) -> str | float:
        """Return the answer to a presentation: one of the study's, or a magnitude."""
        if rng.random() < self._participant.lapse:
            answers = self._study.response.answers
            return answers[int(rng.integers(len(answers)))] if answers else float(rng.uniform(*MAGNITUDE_BOUNDS))
        observer = "" if self._study.simulation is None else self._study.simulation.observer
        key, possible = f"study {self._study.name}: simulation.observer", self._study.response.answers
        try:
            answer = self._perceive(shown, rng)
        except (ValueError, IndexError):  # the stimulus has other parts than those that the observer compares
            raise InputError(key, observer, f"an observer of {self._study.stimulus.pattern}") from None
        if (answer not in possible) if possible else isinstance(answer, str):
            expected = f"an observer whose answers are {', '.join(possible) or 'magnitudes'}; this one answers {answer}"
            raise InputError(key, observer, expected)
        return answer

    def list_visits(self, shown: Presentation) -> Visits:
        """Return the places of a presentation, with the time for which each is felt alone."""
        firsts = np.flatnonzero(np.diff(shown.pixel, prepend=-1))
        lasts = np.append(firsts[1:], len(shown.pixel)) - 1
        start_s, end_s = shown.start_s[firsts], (shown.start_s + shown.width_s)[lasts]
        exposure_s = np.minimum(end_s + PERSISTENCE_S, np.append(start_s[1:], np.inf)) - start_s
        pixel = shown.pixel[firsts]
        return Visits(pixel.tolist(), np.column_stack([self._layout.x_m[pixel], self._layout.y_m[pixel]]), exposure_s)

    def _perceive_places(self, visits: Visits, rng: np.random.Generator) -> FloatArray:
        """Return perceived places, m, [n, 2]."""
        sd_m = self._participant.localisation_sd_m * np.sqrt(REFERENCE_S / visits.exposure_s)
        return np.asarray(visits.position_m + sd_m[:, None] * rng.standard_normal((len(sd_m), 2)))

    def _judge_linear_motion(self, shown: Presentation, rng: np.random.Generator) -> str:
        visits = self.list_visits(shown)
        passes = self._perceive_places(visits, rng).reshape(-1, 3, 2)
        x_m, y_m = (passes[:, 2] - passes[:, 0]).mean(axis=0)
        moved_m = {"right": x_m, "left": -x_m, "up": y_m, "down": -y_m}
        return max(self._study.response.answers, key=moved_m.__getitem__)

    def _judge_rotation(self, shown: Presentation, rng: np.random.Generator) -> str:
        x_m, y_m = self._perceive_places(self.list_visits(shown), rng).T
        area_m2 = 0.5 * np.sum(x_m * np.roll(y_m, -1) - y_m * np.roll(x_m, -1))
        return "ccw" if area_m2 > 0.0 else "cw"

    def _locate(self, shown: Presentation, rng: np.random.Generator) -> str:
        visits = self.list_visits(shown)
        centre_m = visits.position_m[0]
        if len(visits.pixel) == 1:  # the target is the reference, twice
            last_s = shown.start_s[np.argmax(np.diff(shown.start_s)) + 1]
            visits = Visits(visits.pixel, visits.position_m, np.array([shown.duration_s - last_s + PERSISTENCE_S]))
        right, up = (self._perceive_places(visits, rng)[-1] - centre_m) / self._pitch_m
        places = {answer: divmod(int(answer) - 1, 3) for answer in self._study.response.answers}
        return min(places, key=lambda answer: (right - places[answer][1] + 1) ** 2 + (up + places[answer][0] - 1) ** 2)

    def _rate(self, shown: Presentation, rng: np.random.Generator) -> float:
        intensity = self.respond(shown)[0].intensity
        noisy = intensity * np.exp(WEBER_FRACTION * rng.standard_normal())
        brightest = self.respond_at_full_power(shown).intensity
        return float(np.clip(noisy / (FULL_SCALE * brightest), *MAGNITUDE_BOUNDS))

    def _find_odd(self, shown: Presentation, rng: np.random.Generator) -> str:
        felt = np.log1p([list(signals) for signals in self.respond(shown)])
        noisy = felt + WEBER_FRACTION * rng.standard_normal(felt.shape)
        distances = [np.linalg.norm(noisy - one, axis=1).sum() for one in noisy]
        return str(1 + int(np.argmax(distances)))

    def _name_digits(self, shown: Presentation, rng: np.random.Generator) -> str:
        del rng
        columns = {
            digit: {column for _, column in compute_finger_places(digit, self._pitch_m)} for digit in (2, 3, 4, 5)
        }
        middle = int(self._layout.column[self._lattice.pixels_around(None, [(0, 0)], "centre", "a middle")[0]])
        felt = {int(column) - middle for column in self._layout.column[shown.pixel]}
        return "-".join(str(digit) for digit, places in columns.items() if places & felt)

    def _detect(self, shown: Presentation, rng: np.random.Generator) -> str:
        """Name the side on which something is felt, and guess if nothing is."""
        rows = np.arange(len(shown.pixel))
        strongest = max(self._excite(shown, rows, shown.power_w))
        if rng.random() < -np.expm1(-(strongest**DETECTION_SLOPE)):
            return "left" if self._layout.x_m[shown.pixel[0]] < 0.0 else "right"
        return self._study.response.answers[int(rng.integers(len(self._study.response.answers)))]

    def _compare(self, shown: Presentation, rng: np.random.Generator) -> str:
        """Name the stronger of two stimuli, the first or the second of the answers."""
        felt = np.log1p([signals.intensity for signals in self.respond(shown)])
        noisy = felt + WEBER_FRACTION * rng.standard_normal(len(felt))
        return self._study.response.answers[int(noisy.argmax())]

    def respond(self, shown: Presentation) -> list[ChannelSignals]:
        """Return the channels' signals of each stimulus on one pixel. Stimuli are separated by pauses."""
        firsts = np.flatnonzero(np.diff(shown.start_s, prepend=-np.inf) > STIMULUS_PAUSE_S)
        groups = np.split(np.arange(len(shown.pixel)), firsts[1:])
        return [self._respond_to_pulses(shown, rows, shown.power_w) for rows in groups]

    def respond_at_full_power(self, shown: Presentation) -> ChannelSignals:
        """Return the signals of the first stimulus as if at the laser's highest power."""
        firsts = np.flatnonzero(np.diff(shown.start_s, prepend=-np.inf) > STIMULUS_PAUSE_S)
        rows = np.split(np.arange(len(shown.pixel)), firsts[1:])[0]
        return self._respond_to_pulses(shown, rows, np.full(len(shown.pixel), self._display.config.laser.max_power_w))

    def _respond_to_pulses(self, shown: Presentation, rows: IntArray, power_w: FloatArray) -> ChannelSignals:
        return compute_signals(self._excite(shown, rows, power_w))

    def _excite(self, shown: Presentation, rows: IntArray, power_w: FloatArray) -> tuple[float, float]:
        """Return the weighted amplitudes of a stimulus on one cold pixel, in units of the channels' thresholds."""
        start_s = shown.start_s[rows] - shown.start_s[rows[0]]
        pulses = np.column_stack([start_s, shown.width_s[rows], power_w[rows], shown.pixel[rows]])
        pixel = int(shown.pixel[rows[0]])
        meissner, pacinian = compute_pulse_excitations(self._display.build_cold_heat(), pulses, pixel)
        return float(self._sensitivity[pixel] * meissner), float(self._sensitivity[pixel] * pacinian)
