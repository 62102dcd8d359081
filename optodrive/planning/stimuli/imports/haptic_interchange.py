"""Reader of the interchange format of MPEG haptics (ISO/IEC 23090-31, .hjif): its vibrotactile bands.

Source: the reference software of the standard (MPEG haptics, reference model). A position is in ticks, of which a
second has `timescale`. A transient band holds taps, a wave band keyframes of amplitude and frequency, and a curve band
a signal, of which a membrane shows the upper half.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import MISSING, InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.planning.stimuli.imports.haptic_content import LENGTH_MAX_S, RATE_MAX_HZ, Curve, HapticContent
from optodrive.planning.stimuli.imports.haptic_json import CODE, require_entries
from optodrive.planning.stimuli.json_values import require_number

VIBROTACTILE = ("Vibrotactile", "Vibration")
TIMESCALE = 1000
"""Ticks per second of a file that states none."""
TIMESCALE_MAX = 48_000
CHANNELS_NAMED_MAX = 8


class Keyframes(NamedTuple):
    """Keyframes of an effect: times since the start of the content, s, and values, NaN where a keyframe has none."""

    at_s: FloatArray
    amplitude: FloatArray
    frequency_hz: FloatArray

    def interpolate(self, values: FloatArray, default: float) -> Curve:
        """Return the values over time: linear between those stated, constant before and after, or the default."""
        stated = ~np.isnan(values)
        if not stated.any():
            return lambda at_s: np.full(len(at_s), default)
        times_s, known = self.at_s[stated], values[stated]
        return lambda at_s: np.asarray(np.interp(at_s, times_s, known), dtype=np.float64)


class _Channel(NamedTuple):
    place: str
    table: Mapping[str, object]
    library: Mapping[object, Mapping[str, object]]
    factor: float


def read_interchange(table: Mapping[str, object], where: str, channel: int | None, channel_where: str) -> HapticContent:
    """Read one vibrotactile channel of a file.

    channel: from 1, over all vibrotactile perceptions; a file with one needs none

    Raises InputError (bad_haptic, too_many, and bad_parameter for a channel that is missing or unknown).
    """
    ticks = require_number(table.get("timescale", TIMESCALE), f"{where}: timescale", "ticks per second", CODE)
    if not 1 <= ticks <= TIMESCALE_MAX:
        raise InputError(f"{where}: timescale", ticks, f"1 to {TIMESCALE_MAX} ticks per second", code=CODE)
    content, channels = HapticContent(), list[_Channel]()
    for place, perception in require_entries(table, "perceptions", where):
        kind = perception.get("perception_modality", MISSING)
        if kind in VIBROTACTILE:
            channels += _list_channels(perception, place)
        else:
            content.not_shown[f"perception {str(kind)[:40]} (a membrane vibrates)"] += 1
    chosen = _choose(channels, channel, channel_where)
    if chosen is not None:
        gain = require_number(chosen.table.get("gain", 1.0), f"{chosen.place}.gain", "a number", CODE)
        content.gain = abs(gain) * chosen.factor
        for place, band in require_entries(chosen.table, "bands", chosen.place):
            _read_band(band, place, chosen, ticks, content)
    return content


def _list_channels(perception: Mapping[str, object], where: str) -> list[_Channel]:
    library = {
        each.get("id"): each
        for _, each in require_entries({"effect_library": [], **perception}, "effect_library", where)
    }
    exponent = require_number(
        perception.get("perception_unit_exponent", 0), f"{where}.perception_unit_exponent", "a whole number", CODE
    )
    if abs(exponent) > 12:
        raise InputError(f"{where}.perception_unit_exponent", exponent, "at most 12", code=CODE)
    return [
        _Channel(place, each, library, 10.0**exponent) for place, each in require_entries(perception, "channels", where)
    ]


def _choose(channels: list[_Channel], channel: int | None, where: str) -> _Channel | None:
    if channel is None and len(channels) <= 1:
        return channels[0] if channels else None
    if channel is None or not 1 <= channel <= len(channels):
        names = [f"{k} ({str(each.table.get('description', ''))[:40]})" for k, each in enumerate(channels, start=1)]
        shown = ", ".join(names[:CHANNELS_NAMED_MAX]) + (", …" if len(names) > CHANNELS_NAMED_MAX else "")
        expected = f"one of the vibrotactile channels {shown}"
        raise InputError(where, MISSING if channel is None else channel, expected, code="bad_parameter")
    return channels[channel - 1]


def _read_band(band: Mapping[str, object], where: str, channel: _Channel, ticks: float, content: HapticContent) -> None:
    kind = band.get("band_type", MISSING)
    if kind == "WaveletWave":
        content.not_shown["WaveletWave band (coded waves)"] += 1
        return
    if kind not in ("Transient", "VectorialWave", "Curve"):
        expected = "Transient, VectorialWave, Curve or WaveletWave"
        raise InputError(f"{where}.band_type", kind, expected, code=CODE)
    limits_hz = [
        require_number(band.get(f"{side}_frequency_limit", MISSING), f"{where}.{side}_frequency_limit", "a rate", CODE)
        for side in ("lower", "upper")
    ]
    for place, effect in require_entries(band, "effects", where):
        at_ticks = require_number(effect.get("position", MISSING), f"{place}.position", "ticks", CODE)
        effect_kind = effect.get("effect_type", MISSING)
        if effect_kind == "Composite":
            content.not_shown["Composite effect"] += 1
            continue
        if effect_kind == "Reference":
            if effect.get("id") not in channel.library:
                raise InputError(f"{place}.id", effect.get("id", MISSING), "an effect of effect_library", code=CODE)
            effect = channel.library[effect["id"]]
        elif effect_kind != "Basis":
            raise InputError(f"{place}.effect_type", effect_kind, "Basis, Reference or Composite", code=CODE)
        keyframes = _read_keyframes(effect, place, at_ticks, ticks)
        if not len(keyframes.at_s):
            continue
        if kind == "Transient":
            _read_taps(keyframes, place, content)
        elif kind == "VectorialWave":
            _read_wave(effect, keyframes, place, at_ticks / ticks, limits_hz, content)
        else:
            _read_curve(band, keyframes, place, limits_hz[1], content)


def _read_keyframes(effect: Mapping[str, object], where: str, at_ticks: float, ticks: float) -> Keyframes:
    rows = []
    for place, each in require_entries({"keyframes": [], **effect}, "keyframes", where):
        row = [
            require_number(each[key], f"{place}.{key}", "a number", CODE) if key in each else default
            for key, default in (
                ("relative_position", 0.0),
                ("amplitude_modulation", np.nan),
                ("frequency_modulation", np.nan),
            )
        ]
        row[0] = (at_ticks + row[0]) / ticks
        if not 0.0 <= row[0] <= LENGTH_MAX_S:
            expected = f"a position within {LENGTH_MAX_S:g} s"
            raise InputError(f"{place}.relative_position", each.get("relative_position", 0), expected, code=CODE)
        rows.append(row)
    table = np.array(sorted(rows, key=lambda row: row[0])).reshape(-1, 3)
    return Keyframes(table[:, 0], table[:, 1], table[:, 2])


def _read_taps(keyframes: Keyframes, where: str, content: HapticContent) -> None:
    for at_s, amplitude in zip(keyframes.at_s.tolist(), keyframes.amplitude.tolist(), strict=True):
        if np.isnan(amplitude):
            raise InputError(f"{where}.keyframes", MISSING, "an amplitude_modulation of each tap", code=CODE)
        content.taps.append((at_s, abs(amplitude)))


def _read_wave(
    effect: Mapping[str, object],
    keyframes: Keyframes,
    where: str,
    start_s: float,
    limits_hz: list[float],
    content: HapticContent,
) -> None:
    shape = effect.get("base_signal", "Sine")
    if shape != "Sine":
        content.not_shown[f"base_signal {str(shape)[:40]} (a pulse has one shape)"] += 1
    amplitude = keyframes.interpolate(np.abs(keyframes.amplitude), 1.0)
    frequency = keyframes.interpolate(keyframes.frequency_hz, 0.0)
    content.add_vibration(
        where,
        start_s,
        float(keyframes.at_s[-1]),
        lambda at_s: np.minimum(amplitude(at_s), 1.0),
        lambda at_s: np.clip(frequency(at_s), limits_hz[0], limits_hz[1]),
    )


def _read_curve(
    band: Mapping[str, object], keyframes: Keyframes, where: str, upper_hz: float, content: HapticContent
) -> None:
    """Add the upper half of a curve, pulsed at twice the highest frequency of its band."""
    kind = band.get("curve_type", "Unknown")
    if kind not in ("Linear", "Cubic"):
        content.not_shown[f"curve_type {str(kind)[:40]} (shown as Linear)"] += 1
    if (keyframes.amplitude < 0.0).any():
        content.not_shown["lower half of a Curve (a membrane only rises)"] += 1
    stated = ~np.isnan(keyframes.amplitude)
    times_s, values = keyframes.at_s[stated], keyframes.amplitude[stated]
    if not len(times_s):
        raise InputError(f"{where}.keyframes", MISSING, "an amplitude_modulation", code=CODE)

    def evaluate(at_s: FloatArray) -> FloatArray:
        if kind == "Cubic" and len(times_s) > 1:
            left = np.clip(np.searchsorted(times_s, at_s, side="right") - 1, 0, len(times_s) - 2)
            span = np.maximum(times_s[left + 1] - times_s[left], 1e-12)
            share = np.clip((at_s - times_s[left]) / span, 0.0, 1.0)
            return np.clip(values[left] + (values[left + 1] - values[left]) * share**2 * (3 - 2 * share), 0.0, 1.0)
        return np.clip(np.interp(at_s, times_s, values), 0.0, 1.0)

    rate_hz = min(RATE_MAX_HZ, 2.0 * upper_hz)
    content.add_vibration(
        where, float(times_s[0]), float(times_s[-1]), evaluate, lambda at_s: np.full(len(at_s), rate_hz)
    )
