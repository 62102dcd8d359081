"""A hidden display on a bench in virtual time, for campaigns that choose their own experiments.

The clock is that of the generator's sessions: 20 to 90 s from one run to the next, as in a fixed campaign.
"""

from dataclasses import replace
from datetime import timedelta

import numpy as np

from blind_display import DISPLACEMENT, FORCE, TEMPERATURE, compute_max_rise_k
from blind_lab import Case
from blind_session import SAMPLES_S3, build_session_runs, draw_sample_times, measure_signals
from blind_session import Experiment as BlindExperiment
from optodrive.core.types.measurements import Run, Signal
from optodrive.device.config_file import load_config
from optodrive.lab.live_diagnosis import Experiment
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.limiter import limit

PIXELS = (0, 1)
"""The measured pixel and its neighbour, in the generator as on the display of 16 pixels."""


def build_display(case: Case) -> DisplayModel:
    """Return the model of the hidden display: it knows the width of the bridge and no more."""
    width_m = min(SAMPLES_S3, key=lambda item: abs(np.log(item[1] / case.base["R"])))[0]
    config = load_config("display-16")
    display = config.display.model_copy(update={"bridge_width_m": width_m})
    return DisplayModel.from_config(config.model_copy(update={"display": display}))


class BlindBench:
    """Measures a hidden display. Every plan passes the limiter of the display's model as it is.

    played: experiments, one per run; max_rise_k: largest rise of the hidden absorber
    """

    def __init__(self, case: Case, display: DisplayModel) -> None:
        self._case, self._display = case, display
        self._rng = np.random.default_rng([case.seed, 0x11FE])
        self._clock_s = 0.0
        self._dose_j: dict[int, float] = {}
        self._noise_seed = int(self._rng.integers(1_000_000)) * 1000
        self._times_s: dict[str, dict[str, np.ndarray]] = {}
        self.played: list[Experiment] = []
        self.max_rise_k = 0.0

    def now_s(self) -> float:
        """Return the time of the session, s."""
        return self._clock_s

    def run_elsewhere(self, function, *arguments):
        """Run a function here."""
        return function(*arguments)

    def disarm(self) -> None:
        """Nothing emits between two runs."""

    def measure(self, experiment: Experiment) -> Run:
        """Measure temperature, displacement and force of an experiment."""
        case, rng = self._case, self._rng
        limited, _ = limit(experiment.plan, self._display.build_cold_state()[1], self._display.budget, "refuse")
        assert not limited.trimmed_j.any()
        self.max_rise_k = max(self.max_rise_k, compute_max_rise_k(case.truth, experiment.pulses, experiment.pixel))
        if experiment.name not in self._times_s:  # repeats are sampled at equal times
            self._times_s[experiment.name] = {
                name: draw_sample_times(rng, experiment.span_s, case.instruments.rates[name])
                for name in (TEMPERATURE, DISPLACEMENT, FORCE)
            }
        times = self._times_s[experiment.name]
        hidden = BlindExperiment(experiment.name, np.array(experiment.pulses), times, experiment.pixel)
        (run,) = build_session_runs(rng, [hidden], case.instruments)
        self._clock_s += run.session_s
        phase = 2 * np.pi * self._clock_s / case.instruments.ambient_period_s
        room_k = float(case.instruments.ambient_k + case.instruments.ambient_amplitude_k * np.sin(phase))
        run = replace(
            run,
            session_s=self._clock_s,
            dose_j=self._dose_j.get(experiment.pixel, 0.0),
            ambient_k=room_k,
            stated_ambient_k=room_k + run.stated_ambient_k - run.ambient_k,
            noise_seed=self._noise_seed + len(self.played),
        )
        signals = {
            name: Signal(experiment.pixel, t_s, value, case.instruments.stated.get(name))
            for name, t_s, value in measure_signals(run, case.truth, case.instruments, rng)
        }
        for _, width_s, power_w, pixel in experiment.pulses.tolist():
            self._dose_j[int(pixel)] = self._dose_j.get(int(pixel), 0.0) + width_s * power_w
        self.played.append(experiment)
        started = case.instruments.start + timedelta(seconds=self._clock_s)
        attributes: dict[str, str | float] = {"started_at": started.isoformat()}
        self._clock_s += experiment.span_s
        return Run("", run.stated_ambient_k, np.array(experiment.pulses), signals, attributes)
