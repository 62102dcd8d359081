"""Faults in the response of a signal to the light: dead, turned in sign, off in time, or another run's.

Theory of operation

All that is supposed of a pixel is that it heats while the light is on, relaxes after it, and responds more to more
light. Each signal is compared with the light of its run through a bank of first-order lags, with free gain and offset.
The time constant is that which suits most runs, so the gains of the runs can be compared. A run is judged by other runs
of the same pixel that respond to no more light than it had, best by its own repeats, so what a pixel does not show at
low power is no fault of a cable.
"""

from dataclasses import dataclass

import numpy as np

from optodrive.core.quantity import format_quantity, list_names
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import DataFinding, Signal
from optodrive.lab.inspection.work import Found, Step, Work, count

TAUS_S = (0.003, 0.0045, 0.0065, 0.009, 0.013, 0.018, 0.026, 0.037, 0.052, 0.1)
SECOND_S = 0.003
"""Second lag of all signals but the temperature."""
TEMPERATURE = "absorber_temperature_K"
SAMPLES_MAX = 300
"""Samples of a run to which a response is fitted."""
PULSES_MAX = 60
"""Pulses of a run to which a response is fitted."""
MIN_SAMPLES = 24
"""Smallest number of samples of a signal that is judged."""
INDEPENDENT = 5.0
"""Samples that count as one, because noise is correlated."""
VISIBLE = 8.0
"""Expected response in standard errors from which its absence shows."""
FLAT_SHARE = 0.15
"""Largest response of a dead signal, relative to the expected one."""
LESS_LIGHT = 0.6
"""Expected response of a run that judges another one, relative to that one's."""
TURNED = 0.8
"""Share of a signal's variance that a response of opposite sign explains."""
MIN_SHIFT_S = 6e-3
"""Smallest shift that is sought: a diagnosis names smaller ones as a clock's offset."""
MAX_SHIFT_S = 0.1
"""Largest shift."""
SHIFT_AGREES_S = 3e-3
"""Difference within which shifts of signals of one run agree."""
GRID_S = 5e-4
"""Resolution of shifts."""
SHIFTS_S = np.arange(-MAX_SHIFT_S, MAX_SHIFT_S + 5e-4, 1e-3)
"""Shifts that are tried."""
SHIFT_EXPLAINS = 0.95
"""Smallest share of variance that a shifted response explains."""
SHIFT_LEAVES = 0.3
"""Largest share that it leaves of what is left without a shift."""
FITS_UNSHIFTED = 0.98
"""Share explained from which no shift is sought."""
MIN_LEFT = 1e-4
"""Smallest share of variance that counts as left."""
PERIOD_SHARE = 0.6
"""Largest shift of a train, in its periods."""
OWN_FITS = 0.9
"""Share of variance that a run's own light explains, below which it is suspected of being exchanged."""
OTHER_FITS = 0.97
"""Share that another run's light explains, above which it suits."""
GAIN_AGREES = 0.04
"""Agreement of gains with another run's light, in logarithms."""
GAIN_DIFFERS = 0.1
"""Difference of gains with the own light, in logarithms."""
REPEATS_AGREE = 0.03
"""Agreement of the gains of repeats, in logarithms."""
MAX_SUSPICIOUS = 0.3
"""Largest share of runs that can be exchanged."""
FITS_WORSE = 0.05
"""Share by which the own light explains less than in repeats."""
FEW_TYPICAL = 0.01
TYPICAL = {TEMPERATURE: 1.0, "displacement_m": 2e-6, "force_N": 1.15e-4}
"""Typical ratios of the signals, per K; a signal below a hundredth of it in all runs does not respond."""


@dataclass(frozen=True, eq=False)
class Response:
    """Response of one signal of one run to its light.

    share: of the variance that it explains, negative for opposite sign; gain, error: per unit of the template, with the
    standard error; peak: of the template
    """

    run: int
    name: str
    pixel: int
    share: float
    gain: float
    error: float
    peak: float

    @property
    def is_seen(self) -> bool:
        """Whether the signal responds beyond its noise."""
        return abs(self.gain) > 0.5 * VISIBLE * self.error and abs(self.share) > 0.3


Member = tuple[int, Signal, FloatArray, FloatArray, FloatArray]


def compute_template(pulses: FloatArray, t_s: FloatArray, tau_s: float, second_s: float) -> FloatArray:
    """Return the response of one or two lags to the light, W."""
    since_on = np.maximum(t_s[:, None] - pulses[:, 0], 0.0)
    since_off = np.maximum(t_s[:, None] - (pulses[:, 0] + pulses[:, 1]), 0.0)
    first = np.exp(-since_off / tau_s) - np.exp(-since_on / tau_s)
    if second_s:
        slow = 1.02 * second_s if abs(tau_s - second_s) < 0.01 * second_s else tau_s
        first = np.exp(-since_off / slow) - np.exp(-since_on / slow)
        other = np.exp(-since_off / second_s) - np.exp(-since_on / second_s)
        first = (slow * first - second_s * other) / (slow - second_s)
    return np.asarray(first @ pulses[:, 2])


def list_responding(work: Work, name: str) -> list[Member]:
    """Return runs whose light falls on the measured pixel: run, signal, pulses, thinned times and values."""
    return work.remember(("members", name), lambda: _select_responding(work, name))


def _select_responding(work: Work, name: str) -> list[Member]:
    out: list[Member] = []
    for number, t_s, value in work.list_finite(name):
        pulses, signal = work.runs[number].pulses, work.signals[number, name]
        own = pulses[(pulses[:, 3] == signal.pixel) & (pulses[:, 1] * pulses[:, 2] > 0.0)]
        if name.startswith("mirror") or not len(own) or len(value) < MIN_SAMPLES:
            continue
        out.append((number, signal, *thin(own, t_s, value)))
    return out


def thin(pulses: FloatArray, t_s: FloatArray, value: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the first pulses and some of the samples before the next one, or of all if there are hardly any."""
    pulses = pulses[np.argsort(pulses[:, 0], kind="stable")]
    if len(pulses) > PULSES_MAX:
        is_early = t_s < pulses[PULSES_MAX, 0]
        if is_early.sum() >= MIN_SAMPLES:
            t_s, value, pulses = t_s[is_early], value[is_early], pulses[:PULSES_MAX]
    stride = max(1, len(t_s) // SAMPLES_MAX)
    return pulses, t_s[::stride], value[::stride]


def _fit(template: FloatArray, value: FloatArray) -> tuple[float, float, float]:
    """Return the signed share of the variance that a template with offset explains, its gain and the standard error."""
    x, y = template - template.mean(), value - value.mean()
    xx, yy = float(x @ x), float(y @ y)
    if xx <= 1e-9 * max(float(template @ template), 1e-300):
        return 0.0, 0.0, np.inf
    gain = float(x @ y) / xx
    left = max(yy - gain**2 * xx, 0.0)
    share = gain**2 * xx / yy if yy > 0.0 else 0.0
    return float(np.sign(gain) * share), gain, float(np.sqrt(left * INDEPENDENT / (len(y) * xx)))


def measure_responses(work: Work, name: str) -> list[Response]:
    """Return the response of each run with light on the measured pixel, with the time constant that suits most runs."""
    return work.remember(("responses", name), lambda: _measure(work, name))[1]


def measure_time_constant(work: Work, name: str) -> float:
    """Return the time constant that suits most runs, s."""
    return work.remember(("responses", name), lambda: _measure(work, name))[0]


def _measure(work: Work, name: str) -> tuple[float, list[Response]]:
    second_s = get_second_s(name)
    best: tuple[float, list[Response]] = TAUS_S[0], []
    best_share = -1.0
    for tau_s in TAUS_S:
        trial = []
        for number, signal, pulses, t_s, value in list_responding(work, name):
            template = compute_template(pulses, t_s, tau_s, second_s)
            trial.append(Response(number, name, signal.pixel, *_fit(template, value), float(template.max())))
        total = float(np.median([abs(item.share) for item in trial])) if trial else 0.0
        if total > best_share:
            best, best_share = (tau_s, trial), total
    return best


def _find_gain(response: Response, others: list[Response], repeats: list[int]) -> float | None:
    """Return the gain that a run should have: that of its repeats, or of runs with less light that respond."""
    seen = [item for item in others if item.pixel == response.pixel and item.run != response.run and item.is_seen]
    own = [item.gain for item in seen if item.run in repeats]
    if own:
        return float(np.median(own))
    weaker = [item for item in seen if item.peak < LESS_LIGHT * response.peak]
    return float(np.median([item.gain for item in seen])) if weaker else None


def _find_dead(work: Work, name: str) -> Found:
    responses = measure_responses(work, name)
    flat, dark = [], []
    for item in responses:
        gain = _find_gain(item, responses, work.find_repeats(item.run))
        if gain is None or item.is_seen or VISIBLE * item.error > abs(gain):
            continue
        if abs(item.gain) + 3.0 * item.error < FLAT_SHARE * abs(gain):
            flat.append(item.run)
            beside = [own for (run, own) in work.signals if run == item.run and own != name and own in TYPICAL]
            others = [found for own in beside for found in measure_responses(work, own) if found.run == item.run]
            if others and not any(found.is_seen for found in others):
                dark.append(item.run)
    if not flat:
        yield from _find_dead_everywhere(work, name, responses)
        return
    edits = work.drop(name, flat)
    is_stuck = all(len(np.unique(item.values)) == 1 for item in edits)
    what = f"is stuck at {edits[0].values[0]:.6g}" if is_stuck else "does not respond to the light"
    lights = f"; nor does any other signal of {work.list_runs(dark)}: was the light off?" if dark else ""
    yield edits, f"{name} of {work.list_runs(flat)} {what}, as other runs do{lights}"


def _find_dead_everywhere(work: Work, name: str, responses: list[Response]) -> Found:
    """Find a signal that responds in no run although another signal does."""
    if len(responses) < 3 or any(item.is_seen for item in responses) or name not in TYPICAL:
        return
    bound = min(abs(item.gain) + 3.0 * item.error for item in responses)
    for other in (own for own in work.names if own in TYPICAL and own != name):
        seen = [item for item in measure_responses(work, other) if item.is_seen]
        if len(seen) < 3:
            continue
        expected = float(np.median([item.gain for item in seen])) * TYPICAL[name] / TYPICAL[other]
        if bound < FEW_TYPICAL * abs(expected):
            edits = work.drop(name, [run for run, _ in work.list_signals(name)])
            yield edits, f"{name} responds to the light in no run, while {other} does"
            return


def _find_turned(work: Work, name: str) -> Found:
    seen = [item for item in measure_responses(work, name) if abs(item.share) > TURNED and item.is_seen]
    turned = [item.run for item in seen if item.gain < 0.0]
    if turned:
        edits = work.drop(name, turned if 2 * len(turned) <= len(seen) else [run for run, _ in work.list_signals(name)])
        which = f"{count(len(turned), 'run')} ({work.list_runs(turned)})"
        yield edits, f"{name} falls while the light is on in {which}: multiply it by −1"


def _measure_shifts(pulses: FloatArray, t_s: FloatArray, value: FloatArray, second_s: float) -> FloatArray:
    """Return the share of the variance that lags leave [time constants, shifts]."""
    grid_s = np.arange(t_s[0] - MAX_SHIFT_S, t_s[-1] + MAX_SHIFT_S + GRID_S, GRID_S)
    centred = value - value.mean()
    left = []
    for tau_s in TAUS_S:
        even = compute_template(pulses, grid_s, tau_s, second_s)
        shifted = np.interp(t_s - SHIFTS_S[:, None], grid_s, even)
        shifted -= shifted.mean(axis=1, keepdims=True)
        gain, size = shifted @ centred, np.maximum((shifted**2).sum(axis=1), 1e-9 * float(even @ even) + 1e-300)
        left.append(1.0 - np.where(gain > 0.0, gain**2 / size / max(float(centred @ centred), 1e-300), 0.0))
    return np.maximum(np.array(left), MIN_LEFT)


def _find_late_s(left: FloatArray, around_s: float) -> float:
    """Return the shift that leaves least, s, if it leaves far less than those around one, else that one."""
    at = int(np.argmin(left))
    is_near = np.abs(SHIFTS_S - around_s) < MIN_SHIFT_S
    limit = min(1.0 - SHIFT_EXPLAINS, SHIFT_LEAVES * float(left[is_near].min()))
    is_off = not is_near[at] and left[at] < limit
    return float(SHIFTS_S[at]) if is_off else around_s


def _find_shifts_of(work: Work, name: str) -> tuple[float, dict[int, float]]:
    """Return by how much a signal is late in limit runs, s, and by how much in the runs that differ from these."""
    shares = [item.share for item in measure_responses(work, name)]
    if not shares or min(shares) > FITS_UNSHIFTED:
        return 0.0, {}
    second_s = get_second_s(name)
    left: dict[int, FloatArray] = {}
    for number, _, pulses, t_s, value in list_responding(work, name):
        is_early = t_s < (pulses[6, 0] if len(pulses) > 6 else np.inf)
        if is_early.sum() >= MIN_SAMPLES:
            left[number] = _measure_shifts(pulses[:6], t_s[is_early], value[is_early], second_s)
            if len(pulses) > 1:  # a first pulse that was missed looks like a period's delay of a train
                left[number][:, np.abs(SHIFTS_S) > PERIOD_SHARE * float(np.diff(pulses[:, 0]).min())] = 1.0
    if not left:
        return 0.0, {}
    typical = np.median([np.log(item) for item in left.values()], axis=0)
    tau = int(np.argmin(typical.min(axis=1)))
    is_near = np.abs(SHIFTS_S) < MIN_SHIFT_S
    common = np.exp(np.where(is_near, typical[:, :].min(axis=0), typical[tau]))
    common_s = _find_late_s(common, 0.0) if len(left) > 2 else 0.0
    if not common_s:
        tau = int(np.argmin(typical[:, is_near].min(axis=1)))
    late = {run: _find_late_s(item[tau], common_s) for run, item in left.items()}
    return common_s, {run: shift_s for run, shift_s in late.items() if shift_s != common_s}


def get_second_s(name: str) -> float:
    """Return the second lag of a signal, s."""
    return 0.0 if name == TEMPERATURE else SECOND_S


def _find_shifts(work: Work, _: str) -> Found:
    """Find signals whose response starts long before or after the light."""
    found = {name: _find_shifts_of(work, name) for name in work.names if name in TYPICAL}
    common = {name: common_s for name, (common_s, _) in found.items()}
    runs = tuple(run.name for run in work.runs)
    if common and all(common.values()) and np.ptp(list(common.values())) < 2.0 * SHIFT_AGREES_S:
        late_s = float(np.median(list(common.values())))
        text = f"all signals respond {_describe_shift(late_s)} the light in all runs: correct t_s or start_s by it."
        yield DataFinding(runs, "", "trigger", text, "refused", numbers={"shift": (late_s, "s")})
        return
    late: dict[int, list[float]] = {}
    for shift_s, number in ((item, run) for _, differing in found.values() for run, item in differing.items()):
        late.setdefault(number, []).append(shift_s)
    off = {run: min(some) for run, some in late.items() if len(some) > 1 and np.ptp(some) < 2.0 * SHIFT_AGREES_S}
    for name, (common_s, differing) in found.items():
        others = {run: shift_s for run, shift_s in off.items() if (run, name) in work.signals}  # one trigger for all
        own = {number: common_s for number, _ in work.list_signals(name)} if common_s else others | differing
        if own:
            shift = _describe_shift(float(np.median(list(own.values()))))
            text = f"{name} of {work.list_runs(own)} responds {shift} the light: the trigger or the clock is off"
            yield work.drop(name, own), text


def _describe_shift(late_s: float) -> str:
    return f"{format_quantity(abs(late_s), 's', 2)} {'after' if late_s > 0.0 else 'before'}"


def _find_exchanged(work: Work, name: str) -> Found:
    """Find runs whose signal suits the light of another run, and the other's theirs."""
    responses = {item.run: item for item in measure_responses(work, name)}
    second_s = get_second_s(name)
    members = {number: (pulses, t_s, value) for number, _, pulses, t_s, value in list_responding(work, name)}
    if len(responses) < 3:
        return
    tau_s = measure_time_constant(work, name)
    expected: dict[int, tuple[float, float, float]] = {}  # gain, its tolerance and the share, of the repeats or of all
    deviations = []
    for run, item in responses.items():
        repeats = [responses[other] for other in work.find_repeats(run) if other in responses]
        others = [other for other in responses.values() if other.run != run and other.pixel == item.pixel]
        usual = repeats or others
        if usual:
            gain, share = (float(np.median([getattr(other, key) for other in usual])) for key in ("gain", "share"))
            tolerance = GAIN_AGREES if repeats else 4.0 * GAIN_AGREES
            expected[run] = gain, tolerance + 3.0 * item.error / max(abs(gain), 1e-300), min(share - 0.03, OTHER_FITS)
        if repeats:
            deviations.append(abs(_log_ratio(item.gain, expected[run][0])))
    repeats_agree = bool(deviations) and float(np.median(deviations)) < REPEATS_AGREE

    def is_suspicious(run: int) -> bool:
        """Return whether a run's light explains it worse than that of its repeats, or whether none has its gain."""
        gain, tolerance, min_share = expected[run]
        repeats = [responses[other].gain for other in work.find_repeats(run) if other in responses]
        off = min(abs(_log_ratio(responses[run].gain, other)) for other in repeats or [gain])
        is_unlike = responses[run].share < min(OWN_FITS, min_share - FITS_WORSE)
        return is_unlike or (repeats_agree and off > max(GAIN_DIFFERS, 3.0 * tolerance))

    def suits(run: int, light: int) -> bool:
        _, t_s, value = members[run]
        share, gain, _ = _fit(compute_template(members[light][0], t_s, tau_s, second_s), value)
        usual, tolerance, min_share = expected[light]
        return share > max(min_share, responses[run].share - 0.01) and abs(_log_ratio(gain, usual)) < tolerance

    suspicious = [run for run in expected if responses[run].peak and is_suspicious(run)]
    if len(suspicious) > max(2, len(responses) * MAX_SUSPICIOUS):
        return
    pairs = []
    for at, run in enumerate(suspicious):
        for other in suspicious[at + 1 :]:
            is_same_light = np.array_equal(members[run][0], members[other][0])
            is_possible = not is_same_light and responses[run].pixel == responses[other].pixel
            if is_possible and suits(run, other) and suits(other, run):
                pairs.append((run, other))
    if pairs:
        shown = list_names([" and ".join(work.runs[run].name for run in pair) for pair in pairs])
        edits = work.drop(name, dict.fromkeys(run for pair in pairs for run in pair))
        yield edits, f"{name} of {shown} follow each other's light, not their own: the two are probably exchanged"


def _log_ratio(one: float, other: float) -> float:
    return float(np.log(one / other)) if one > 0.0 and other > 0.0 else np.inf


RESPONSE_STEPS = (
    Step("sign", _find_turned),
    Step("trigger", _find_shifts, is_joint=True),
    Step("exchanged", _find_exchanged),
    Step("dead", _find_dead),
)
