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

Intervals are compared by one feature: intensity, rate of the pulses, longest pause, or distance of the outermost
places, each with noise. Onsets are ordered with a standard deviation of 30 ms (some 20 to 40 ms for taps on two places;
Hirsh and Sherrick 1961). A pattern is identified by the nearest of the study's own, pixel by pixel, with the sense of
place above. Two places are felt as one motion if their onsets are less than some 150 ms apart (Kirman 1974).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
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
from optodrive.study.trial_list import ListedTrial
from optodrive.study.trial_stimulus import build_stimulus, find_correct_answer

REFERENCE_S = 0.5
WEBER_FRACTION = 0.2
DETECTION_SLOPE = 3.0
"""Slope of the Weibull function of detection over the amplitude; some 3 for vibration."""
STIMULUS_PAUSE_S = 0.2
"""Pause without a pulse that separates two stimuli on one pixel."""
MAGNITUDE_BOUNDS = (0.01, 0.99)
FULL_SCALE = 1.25
"""End of the scale of magnitudes, as a factor of the intensity at the highest power."""
NUMBER_SCALE = 50.0
"""Number for the strongest sensation, where any number may be answered."""
FEATURE_NOISE = {"intensity": WEBER_FRACTION, "rate": WEBER_FRACTION, "gap": 0.010, "extent": 2e-3}
"""Standard deviation of each feature, in its own unit."""
SAME_PULSE_S = 2e-3
"""Pause up to which two pulses are one."""
ORDER_SD_S = 0.030
MOTION_S, MOTION_NOISE = 0.150, 0.4
"""Largest time between two onsets of one motion, s, and the standard deviation of its logarithm."""


@dataclass(frozen=True)
class Participant:
    """A simulated participant. The defaults are fitted to the paper (docs/explanation/perception.md)."""

    localisation_sd_m: float = 1.35e-3
    lapse: float = 0.025
    acuity: float = 1.0
    """Factor by which places, features of intervals and onsets are told apart more finely."""


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
        self.study, self._display, self._participant = study, display, participant
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
            "interval": self._choose_interval,
            "order": self._order,
            "identification": self._identify,
            "motion": self._judge_motion,
        }
        self._perceive = rules[study.simulation.observer]

    def answer(self, shown: Presentation, rng: np.random.Generator) -> str | float:
        """Return the answer to a presentation: one of the study's, or a magnitude."""
        if rng.random() < self._participant.lapse or not len(shown.pixel):
            answers = self.study.response.answers
            return answers[int(rng.integers(len(answers)))] if answers else self._scale(float(rng.uniform()))
        observer = "" if self.study.simulation is None else self.study.simulation.observer
        key, possible = f"study {self.study.name}: simulation.observer", self.study.response.answers
        try:
            answer = self._perceive(shown, rng)
        except (ValueError, IndexError, KeyError):  # the stimulus has other parts than those that the observer compares
            raise InputError(key, observer, f"an observer of {self.study.stimulus.pattern}") from None
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
        sd_m = self._participant.localisation_sd_m / self._participant.acuity * np.sqrt(REFERENCE_S / visits.exposure_s)
        return np.asarray(visits.position_m + sd_m[:, None] * rng.standard_normal((len(sd_m), 2)))

    def _judge_linear_motion(self, shown: Presentation, rng: np.random.Generator) -> str:
        visits = self.list_visits(shown)
        passes = self._perceive_places(visits, rng).reshape(-1, 3, 2)
        x_m, y_m = (passes[:, 2] - passes[:, 0]).mean(axis=0)
        moved_m = {"right": x_m, "left": -x_m, "up": y_m, "down": -y_m}
        return max(self.study.response.answers, key=moved_m.__getitem__)

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
        places = {answer: divmod(int(answer) - 1, 3) for answer in self.study.response.answers}
        return min(places, key=lambda answer: (right - places[answer][1] + 1) ** 2 + (up + places[answer][0] - 1) ** 2)

    def _rate(self, shown: Presentation, rng: np.random.Generator) -> float:
        intensity = self.respond(shown)[0].intensity
        noisy = intensity * np.exp(WEBER_FRACTION * rng.standard_normal())
        brightest = self.respond_at_full_power(shown).intensity
        return self._scale(noisy / (FULL_SCALE * brightest))

    def _scale(self, share: float) -> float:
        """Return a share of the strongest sensation on the scale of the study, which has no end for numbers."""
        bounded = float(np.clip(share, *MAGNITUDE_BOUNDS))
        return bounded if self.study.response.kind == "magnitude" else round(NUMBER_SCALE * bounded, 1)

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
        return self.study.response.answers[int(rng.integers(len(self.study.response.answers)))]

    def _compare(self, shown: Presentation, rng: np.random.Generator) -> str:
        """Name the stronger of two stimuli, the first or the second of the answers."""
        felt = np.log1p([signals.intensity for signals in self.respond(shown)])
        noisy = felt + WEBER_FRACTION * rng.standard_normal(len(felt))
        return self.study.response.answers[int(noisy.argmax())]

    def _split(self, shown: Presentation) -> list[IntArray]:
        """Return the pulses of each interval, as rows."""
        return [
            np.flatnonzero((shown.start_s >= start_s - 1e-3) & (shown.start_s < end_s - 1e-3))
            for _, start_s, end_s in shown.intervals
        ]

    def _choose_interval(self, shown: Presentation, rng: np.random.Generator) -> str:
        """Name the interval with the largest feature by its place."""
        feature = "intensity" if self.study.simulation is None else self.study.simulation.feature
        felt = [self._measure(feature, shown, rows) if len(rows) else 0.0 for rows in self._split(shown)]
        sd = FEATURE_NOISE[feature] / (1.0 if feature == "intensity" else self._participant.acuity)
        noisy = np.array(felt) + sd * rng.standard_normal(len(felt))
        return self.study.response.answers[int(noisy.argmax())]

    def _measure(self, feature: str, shown: Presentation, rows: IntArray) -> float:
        """Return a feature of a stimulus: logarithms of 1 + intensity and of the rate, s of a pause, m of an extent."""
        start_s, end_s, pixel = shown.start_s[rows], (shown.start_s + shown.width_s)[rows], shown.pixel[rows]
        if feature == "intensity":
            signals = [self._respond_to_pulses(shown, rows[pixel == one], shown.power_w) for one in np.unique(pixel)]
            return float(np.log1p(max(each.intensity for each in signals)))
        if feature == "extent":
            x_m, y_m = self._layout.x_m[pixel], self._layout.y_m[pixel]
            return float(np.hypot(x_m[:, None] - x_m, y_m[:, None] - y_m).max())
        pauses_s = (start_s[1:] - end_s[:-1])[start_s[1:] - end_s[:-1] > SAME_PULSE_S]
        if feature == "gap":
            return float(pauses_s.max(initial=0.0))
        return float(np.log(max(1, len(pauses_s)) / max(start_s[-1] - start_s[0], SAME_PULSE_S)))

    def _order(self, shown: Presentation, rng: np.random.Generator) -> str:
        """Name the interval that seems to begin first."""
        onset_s = [shown.start_s[rows[0]] if len(rows) else np.inf for rows in self._split(shown)]
        sd_s = ORDER_SD_S / self._participant.acuity
        return shown.intervals[int(np.argmin(np.array(onset_s) + sd_s * rng.standard_normal(len(onset_s))))].name

    def _identify(self, shown: Presentation, rng: np.random.Generator) -> str:
        """Name the pattern whose places are nearest to those that are felt."""
        pixel = np.unique(shown.pixel)
        exposure_s = np.full(len(pixel), shown.duration_s + PERSISTENCE_S)
        position_m = np.column_stack([self._layout.x_m[pixel], self._layout.y_m[pixel]])
        felt_m = self._perceive_places(Visits(pixel.tolist(), position_m, exposure_s), rng)
        return min(self._templates, key=lambda name: _measure_distance_m(felt_m, self._templates[name]))

    @cached_property
    def _templates(self) -> dict[str, FloatArray]:
        """Places of the pattern of each correct answer, m, [n, 2]."""
        found: dict[str, FloatArray] = {}
        for condition in self.study.conditions:
            trial = ListedTrial("main", "main", False, condition, self.study.interval_names)
            sequence = build_stimulus(self.study, trial, condition, self._display.config).sequence
            answer = find_correct_answer(self.study, trial, condition)
            if sequence is not None and answer is not None:
                pixels = {train.pixel for train in sequence.trains}
                pixels |= {int(pixel) for frame in sequence.frames for pixel in np.flatnonzero(frame.target_m)}
                index = sorted(pixels)
                found[answer] = np.column_stack([self._layout.x_m[index], self._layout.y_m[index]])
        return found

    def _judge_motion(self, shown: Presentation, rng: np.random.Generator) -> str:
        """Judge whether two places follow each other fast enough to be one motion."""
        between_s = float(np.diff(shown.start_s[np.flatnonzero(np.diff(shown.pixel, prepend=-1))]).mean())
        return "motion" if between_s * np.exp(MOTION_NOISE * rng.standard_normal()) < MOTION_S else "succession"

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


def _measure_distance_m(felt_m: FloatArray, pattern_m: FloatArray) -> float:
    """Return the mean distance from each place to the nearest of the other pattern, both ways, m. [n, 2], [m, 2]."""
    distance_m = np.linalg.norm(felt_m[:, None] - pattern_m[None], axis=2)
    return float(distance_m.min(axis=0).mean() + distance_m.min(axis=1).mean())
