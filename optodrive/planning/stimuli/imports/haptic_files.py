"""Reader of haptic files: .haptic of the Meta Haptics SDK, AHAP of Core Haptics, and the interchange of MPEG haptics.

Sources: the .haptic File Specification 1.0 of the Meta Haptics SDK; Apple's "Representing haptic patterns in AHAP
files" and the headers of Core Haptics. Frequency and sharpness, 0 to 1 in both, become rates between two that the
caller states, because both formats leave them to the device.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import MISSING, InputError, Unquoted
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.stimuli import FrameSequence
from optodrive.device.config import Config
from optodrive.planning.stimuli.imports.haptic_content import (
    FILE_BYTES_MAX,
    HapticContent,
    build_pulse_frames,
)
from optodrive.planning.stimuli.imports.haptic_interchange import read_interchange
from optodrive.planning.stimuli.imports.haptic_json import (
    CODE,
    read_time,
    require_entries,
    require_table,
    require_within,
)
from optodrive.planning.stimuli.json_values import decode_json, require_number

HAPTIC_MAJOR = 1
DEFAULT_FREQUENCY = 0.5
"""Frequency of a .haptic file without a frequency envelope."""
TRANSIENT, CONTINUOUS = "HapticTransient", "HapticContinuous"
SILENT_EVENTS = ("AudioContinuous", "AudioCustom")
ENVELOPE_PARAMETERS = {"AttackTime": 0.0, "DecayTime": 0.0, "ReleaseTime": 0.0, "Sustained": 1.0}
"""Event parameters of an envelope whose times no document states, and the values at which they do nothing."""
ENVELOPE_CONTROLS = ("HapticAttackTimeControl", "HapticDecayTimeControl", "HapticReleaseTimeControl")


class Rates(NamedTuple):
    """Rates of the lowest and the highest frequency of a file, Hz."""

    low_hz: float
    high_hz: float

    def convert(self, frequency: FloatArray) -> FloatArray:
        """Return the rates of frequencies between 0 and 1."""
        return self.low_hz + (self.high_hz - self.low_hz) * frequency


def build_haptic_file(
    config: Config,
    where: str,
    file: bytes,
    pixels: str | None,
    height_m: float,
    low_hz: float,
    high_hz: float,
    channel: int | None,
    lossy: bool,
) -> FrameSequence:
    """Build the vibrations and taps of a haptic file on the chosen pixels.

    height_m: of strength 1; low_hz, high_hz: rates of frequency 0 and 1; channel: of a file with several, from 1
    lossy: whether to leave out what a membrane cannot show, instead of refusing the file

    Raises InputError (bad_json, bad_haptic, not_shown, bad_parameter, unknown_pixel, too_many, raises_nothing).
    """
    place = f"{where}: file"
    if high_hz < low_hz:
        raise InputError(f"{where}: high_hz", high_hz, f"at least low_hz, {low_hz:g} Hz", code="bad_parameter")
    content = read_haptic_file(file, place, Rates(low_hz, high_hz), channel, f"{where}: channel")
    if not lossy:
        content.refuse_not_shown(place)
    return build_pulse_frames(config, where, content.list_pulses(place), pixels, height_m, "haptic")


def read_haptic_file(file: bytes, where: str, rates: Rates, channel: int | None, channel_where: str) -> HapticContent:
    """Read a file of any of the three formats, which its members tell apart.

    Raises InputError (bad_json, bad_haptic, too_many, and bad_parameter for a channel).
    """
    if len(file) > FILE_BYTES_MAX:
        raise InputError(where, Unquoted(f"{len(file)} bytes"), f"at most {FILE_BYTES_MAX}", code="too_many")
    table = require_table(decode_json(file, where), where)
    if "perceptions" in table:
        return read_interchange(table, where, channel, channel_where)
    if channel is not None and channel != 1:
        raise InputError(channel_where, channel, "1: this format has one channel", code="bad_parameter")
    if "signals" in table:
        return _read_haptic(table, where, rates)
    if "Pattern" in table:
        return _read_ahap(table, where, rates)
    expected = "signals (.haptic), Pattern (AHAP) or perceptions (.hjif) among its members"
    raise InputError(where, Unquoted(f"members {', '.join(list(table)[:5]) or 'none'}"), expected, code=CODE)


def _read_haptic(table: Mapping[str, object], where: str, rates: Rates) -> HapticContent:
    """Read a .haptic file, whose emphases become taps."""
    version = require_table(table.get("version", MISSING), f"{where}: version")
    if version.get("major") != HAPTIC_MAJOR:
        raise InputError(f"{where}: version.major", version.get("major", MISSING), str(HAPTIC_MAJOR), code=CODE)
    place = f"{where}: signals.continuous.envelopes"
    signals = require_table(table["signals"], f"{where}: signals")
    continuous = require_table(signals.get("continuous", MISSING), f"{where}: signals.continuous")
    envelopes = require_table(continuous.get("envelopes", MISSING), place)
    times_s, strengths = _read_envelope(envelopes, "amplitude", place)
    if len(times_s) < 2 or times_s[-1] <= times_s[0]:
        expected = "at least two breakpoints, the last one later than the first"
        raise InputError(f"{place}.amplitude", Unquoted(f"{len(times_s)}"), expected, code=CODE)
    rate_times_s, frequencies = np.zeros(1), np.full(1, DEFAULT_FREQUENCY)
    if envelopes.get("frequency"):
        rate_times_s, frequencies = _read_envelope(envelopes, "frequency", place)
        if rate_times_s[-1] > times_s[-1]:
            expected = f"none after the last amplitude, {times_s[-1]:g} s"
            raise InputError(f"{place}.frequency", float(rate_times_s[-1]), expected, code=CODE)
    content = HapticContent()
    content.add_vibration(
        where,
        float(times_s[0]),
        float(times_s[-1]),
        lambda at_s: np.interp(at_s, times_s, strengths),
        lambda at_s: rates.convert(np.interp(at_s, rate_times_s, frequencies)),
    )
    for k, (at, point) in enumerate(require_entries(envelopes, "amplitude", place)):
        if "emphasis" in point:
            emphasis = require_table(point["emphasis"], f"{at}.emphasis")
            tap = require_within(emphasis, "amplitude", f"{at}.emphasis", float(strengths[k]), 1.0)
            require_within(emphasis, "frequency", f"{at}.emphasis", 0.0, 1.0)
            content.taps.append((float(times_s[k]), tap))
    return content


def _read_envelope(envelopes: Mapping[str, object], key: str, where: str) -> tuple[FloatArray, FloatArray]:
    """Return the times and values of an envelope's breakpoints."""
    points = require_entries(envelopes, key, where)
    times_s = np.array([read_time(point, "time", place) for place, point in points])
    earlier = np.flatnonzero(np.diff(times_s) < 0.0)
    if len(earlier):
        place, value = points[earlier[0] + 1][0], float(times_s[earlier[0] + 1])
        raise InputError(f"{place}.time", value, "a time not before the one before it", code=CODE)
    return times_s, np.array([require_within(point, key, place, 0.0, 1.0) for place, point in points])


class _Control:
    """A dynamic parameter of an AHAP file over time: a value until a parameter or a curve sets another one."""

    def __init__(self, default: float, low: float) -> None:
        self._times_s, self._values, self._low = [0.0], [default], low

    def set(self, start_s: float, points: list[tuple[float, float]]) -> None:
        """Let the value go to the points, whose times count from start_s, and stay at the last one."""
        before = float(self.sample(np.array([start_s]))[0])
        kept = sum(each <= start_s for each in self._times_s)
        values = [min(max(value, self._low), 1.0) for _, value in points]
        self._times_s = [*self._times_s[:kept], start_s, *(start_s + at_s for at_s, _ in points)]
        self._values = [*self._values[:kept], before, *values]

    def sample(self, at_s: FloatArray) -> FloatArray:
        """Return the values at times."""
        return np.asarray(np.interp(at_s, self._times_s, self._values), dtype=np.float64)


def _read_ahap(table: Mapping[str, object], where: str, rates: Rates) -> HapticContent:
    """Read an AHAP file. Values beyond their range are bounded, and unknown keys ignored, as Core Haptics does."""
    entries = require_entries(table, "Pattern", where)
    content, intensity, sharpness = HapticContent(), _Control(1.0, 0.0), _Control(0.0, -1.0)
    controls = {"HapticIntensityControl": intensity, "HapticSharpnessControl": sharpness}
    changes = []
    for place, entry in entries:
        for key in ("Parameter", "ParameterCurve"):
            if key in entry:
                changes.append(_read_change(require_table(entry[key], f"{place}.{key}"), key, f"{place}.{key}"))
    for start_s, name, points in sorted(changes, key=lambda change: change[0]):
        if name in controls:
            controls[name].set(start_s, points)
        elif name in ENVELOPE_CONTROLS:
            content.not_shown[f"{name} (no document states its times)"] += 1
    for place, entry in entries:
        if "Event" in entry:
            event = require_table(entry["Event"], f"{place}.Event")
            _read_event(event, f"{place}.Event", content, intensity, sharpness, rates)
    return content


def _read_change(change: Mapping[str, object], key: str, where: str) -> tuple[float, str, list[tuple[float, float]]]:
    """Return the time, the name and the points of a dynamic parameter or of its curve."""
    start_s = read_time({"Time": 0.0, **change}, "Time", where)
    if key == "Parameter":
        return start_s, str(change.get("ParameterID")), [(0.0, _read_value(change, where))]
    points = require_entries(change, "ParameterCurveControlPoints", where)
    read = [(read_time(point, "Time", place), _read_value(point, place)) for place, point in points]
    return start_s, str(change.get("ParameterID")), sorted(read, key=lambda point: point[0])


def _read_value(table: Mapping[str, object], where: str) -> float:
    return require_number(table.get("ParameterValue", MISSING), f"{where}.ParameterValue", "a number", CODE)


def _read_event(
    event: Mapping[str, object],
    where: str,
    content: HapticContent,
    intensity: _Control,
    sharpness: _Control,
    rates: Rates,
) -> None:
    kind = event.get("EventType", MISSING)
    if kind in SILENT_EVENTS:
        content.not_shown[f"{kind} (a membrane makes no sound)"] += 1
        return
    if kind not in (TRANSIENT, CONTINUOUS):
        expected = f"one of {TRANSIENT}, {CONTINUOUS}, {', '.join(SILENT_EVENTS)}"
        raise InputError(f"{where}.EventType", kind, expected, code=CODE)
    start_s = read_time({"Time": 0.0, **event}, "Time", where)
    given = {
        str(each.get("ParameterID")): _read_value(each, place)
        for place, each in require_entries({"EventParameters": [], **event}, "EventParameters", where)
    }
    strength = _require_stated(given, "HapticIntensity", where)
    if kind == TRANSIENT:
        content.taps.append((start_s, strength * float(intensity.sample(np.array([start_s]))[0])))
        return
    for name, idle in ENVELOPE_PARAMETERS.items():
        if given.get(name, idle) != idle:
            content.not_shown[f"{name} (no document states its time)"] += 1
    feel = _require_stated(given, "HapticSharpness", where)
    end_s = start_s + read_time(event, "EventDuration", where)
    content.add_vibration(
        where,
        start_s,
        end_s,
        lambda at_s: strength * intensity.sample(at_s),
        lambda at_s: rates.convert(np.clip(feel + sharpness.sample(at_s), 0.0, 1.0)),
    )


def _require_stated(given: Mapping[str, float], name: str, where: str) -> float:
    """Return a parameter between 0 and 1, whose default no document of Core Haptics states."""
    if name not in given:
        raise InputError(f"{where}: {name}", MISSING, "this parameter: no document states its default", code=CODE)
    return min(max(given[name], 0.0), 1.0)
