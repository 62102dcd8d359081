"""Ground-truth servos with one nonlinear effect, by code and forms that the identification does not have."""

from dataclasses import dataclass

import numba
import numpy as np

from optodrive.core.types.measurements import Measurement, Run, Signal

NO_PULSES = np.zeros((0, 4))
KINDS = (
    "linear",
    "linear with a lag",
    "slew",
    "speed",
    "clip",
    "arctangent",
    "torque",
    "stop",
    "Coulomb",
    "smooth friction",
    "LuGre",
    "play",
    "Bouc-Wen",
    "Preisach",
    "Duffing",
    "quintic",
    "softening",
)
EFFECT_OF = {
    **dict.fromkeys(KINDS[:2]),
    **dict.fromkeys(KINDS[2:4], "slew_limit"),
    **dict.fromkeys(KINDS[4:8], "saturation"),
    **dict.fromkeys(KINDS[8:11], "dry_friction"),
    **dict.fromkeys(KINDS[11:14], "hysteresis"),
    **dict.fromkeys(KINDS[14:], "amplitude_dependent_stiffness"),
}


@numba.njit(cache=True)
def _follow(kind, size, hz, damping, reference, command, h_s):
    """Return the angle after each explicit midpoint step of h_s; size: of the effect relative to `reference` (rad)."""
    w = 2.0 * np.pi * hz
    v = z = xm = vm = a = 0.0
    r = command[0]
    x = r
    lag = r
    relays = np.full(400, 1.0)
    relays[::2] = -1.0
    out = np.empty(len(command))
    for n in range(len(command)):
        u = command[n]
        if kind == 1:
            lag += h_s * 2.0 * np.pi * 1.7 * hz * (u - lag)
            r = lag
        elif kind == 2:
            change = size * w * reference * h_s
            r += min(max(u - r, -change), change)
        elif kind == 4:
            r = min(max(u, -size * reference), size * reference)
        elif kind == 5:
            r = size * reference * np.arctan(u / (size * reference))
        elif kind == 11:
            gap = size * reference
            if u - r > gap:
                r = u - gap
            elif r - u > gap:
                r = u + gap
        elif kind == 12:
            before = command[n - 1] if n else u
            du = u - before
            width = 0.5 * reference
            parts = 1 + int(abs(du) / (0.02 * width))
            for _ in range(parts):
                z += du / parts - (0.7 * abs(du) * abs(z) * z + 0.3 * du * z * z) / parts / width**2
            r = u - size * z
        elif kind == 13:
            total = 0.0
            for k in range(400):
                up = reference * 1.5 * (k % 20 + 1) / 20.0
                middle = reference * 3.0 * (k // 20 - 9.5) / 10.0
                if u > middle + up:
                    relays[k] = 1.0
                elif u < middle - up:
                    relays[k] = -1.0
                total += relays[k]
            r = u + size * reference * total / 400.0
        else:
            r = u
        for half in range(2):
            xs = x if half == 0 else xm
            vs = v if half == 0 else vm
            pull = w * w * (r - xs)
            if kind == 6:
                limit = size * w * w * reference
                pull = min(max(pull, -limit), limit)
            a = pull - 2.0 * damping * w * vs
            if kind == 14:
                a -= w * w * size * xs**3 / reference**2
            elif kind == 15:
                a -= w * w * size * xs**5 / reference**4
            elif kind == 16:
                a += w * w * size * xs * abs(xs) / (reference + abs(xs))
            elif kind == 9:
                a -= w * w * size * reference * np.tanh(vs / (0.004 * w * reference))
            elif kind == 10:
                a -= w * w * size * reference * z
            if half == 0:
                xm = x + 0.5 * h_s * v
                vm = v + 0.5 * h_s * a
        x1 = x + h_s * vm
        v1 = v + h_s * a
        if kind == 8:
            grip = w * w * size * reference * h_s
            v1 = 0.0 if abs(v1) <= grip else v1 - np.sign(v1) * grip
            x1 = x + 0.5 * h_s * (v + v1)
        elif kind == 10:
            stretch = 0.006 * reference
            peak = 1.0 + 0.4 * np.exp(-((v1 / (0.02 * w * reference)) ** 2))
            end = peak if v1 >= 0.0 else -peak
            z = end - (end - z) * np.exp(-abs(v1) * h_s / (stretch * peak))
        elif kind == 3:
            limit = size * w * reference
            v1 = min(max(v1, -limit), limit)
            x1 = x + 0.5 * h_s * (v + v1)
        elif kind == 7 and abs(x1) > size * reference:
            x1 = np.sign(x1) * size * reference
            v1 = 0.0
        x, v = x1, v1
        out[n] = x
    return out


SIZES = {  # least and greatest size of each effect, relative to the command's rms at the largest amplitude
    "linear": (0.0, 0.0),
    "linear with a lag": (0.0, 0.0),
    "slew": (0.25, 0.7),
    "speed": (0.25, 0.7),
    "clip": (1.0, 2.0),
    "arctangent": (1.5, 4.0),
    "torque": (0.5, 1.2),
    "stop": (1.0, 2.0),
    "Coulomb": (0.02, 0.1),
    "smooth friction": (0.02, 0.1),
    "LuGre": (0.02, 0.1),
    "play": (0.03, 0.2),
    "Bouc-Wen": (0.08, 0.3),
    "Preisach": (0.1, 0.4),
    "Duffing": (0.03, 0.2),
    "quintic": (0.01, 0.05),
    "softening": (0.08, 0.3),
}


@dataclass(frozen=True)
class HiddenServo:
    """A servo with the effect `kind` of a size relative to the largest command's rms."""

    kind: str
    size: float
    hz: float
    damping: float
    delay_s: float

    @classmethod
    def sample(cls, kind, random):
        low, high = SIZES[kind]
        size = float(np.exp(random.uniform(np.log(low), np.log(high)))) if high else 0.0
        hz = float(np.exp(random.uniform(np.log(300.0), np.log(2000.0))))
        return cls(kind, size, hz, float(random.uniform(0.3, 0.9)), float(random.uniform(0.0, 1e-4)))

    def follow(self, command_rad, rate_hz, reference_rad):
        """Return the angle at each sample for commands held for one sample each."""
        fine = max(1, int(np.ceil(60.0 * self.hz / rate_hz)))
        fine *= 4
        at = np.arange(len(command_rad) * fine) / (fine * rate_hz)
        row = np.clip(np.floor((at - self.delay_s) * rate_hz).astype(int), 0, None)
        dense = command_rad[row]
        out = _follow(
            KINDS.index(self.kind), self.size, self.hz, self.damping, reference_rad, dense, 1.0 / (fine * rate_hz)
        )
        return np.concatenate([command_rad[:1], out[fine - 1 :: fine][:-1]])


def excitation(random, form, count, rate_hz, hz):
    """Return a command of rms 1, from 0: a multisine, filtered noise, a sweep or random holds, up to 2 hz."""
    t_s = np.arange(count) / rate_hz
    if form == "multisine":
        lines = np.arange(1, int(2.0 * hz * count / rate_hz))
        spectrum = np.zeros(count // 2 + 1, complex)
        spectrum[lines] = np.exp(2j * np.pi * random.random(len(lines)))
        value = np.fft.irfft(spectrum, count)
    elif form == "noise":
        value = np.convolve(random.standard_normal(count), np.hanning(max(3, int(rate_hz / hz))), "same")
    elif form == "sweep":
        end = 1.5 * hz * random.uniform(0.8, 1.2)
        value = np.sin(2.0 * np.pi * (5.0 * t_s + 0.5 * (end - 5.0) * t_s**2 / t_s[-1]) + random.uniform(0.0, 6.0))
    else:
        hold = max(1, int(random.uniform(1.0, 2.0) * rate_hz / hz))
        value = np.repeat(random.uniform(-1.0, 1.0, count // hold + 1), hold)[:count]
    ramp = np.minimum(1.0, t_s / (0.02 * t_s[-1]))
    value = value * ramp
    return value / np.sqrt(np.mean(value**2))


def recording(servos, random, form="multisine", amplitudes_rad=(0.005, 0.015, 0.05), noise=0.002, count=4096):
    """Build a recording with two runs per amplitude. noise: relative to the smallest amplitude."""
    runs = []
    rate_hz = 25.0 * max(servo.hz for servo in servos)
    for level, rms_rad in enumerate(amplitudes_rad):
        for repeat in range(2):
            x, y = (rms_rad * excitation(random, form, count, rate_hz, servo.hz) for servo in servos)
            t_s = np.arange(count) / rate_hz
            signals = {}
            for name, servo, command in zip("xy", servos, (x, y), strict=True):
                angle = servo.follow(command, rate_hz, max(amplitudes_rad))
                angle = angle + noise * min(amplitudes_rad) * random.standard_normal(count)
                signals[f"mirror_{name}_rad"] = Signal(0, t_s, angle)
            runs.append(Run(f"run{level}{repeat}", 295.0, NO_PULSES, signals, {}, np.column_stack([t_s, x, y])))
    return Measurement(tuple(runs))
