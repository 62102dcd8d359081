"""Pulses that follow the envelope of a sound: WAV files with samples of any width, as integers or floats."""

import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from optodrive.core.errors import InputError, Unquoted, build_nothing_raised_error
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.stimuli import FrameSequence
from optodrive.device.config import Config
from optodrive.planning.stimuli.imports.haptic_content import STRENGTH_MIN, build_pulse_frames
from optodrive.planning.stimuli.sequence_file import FRAMES_MAX

CODE = "bad_sound"
INTEGER, FLOAT, EXTENSIBLE = 1, 3, 0xFFFE
"""Sample formats of a WAV file; the last names one of the others further on."""
SAMPLES_MAX = 20_000_000
"""Largest number of samples of all channels."""
SILENCE = 1e-4
"""Level below which a sound counts as silent, of full scale (−80 dB)."""


class Sound(NamedTuple):
    """Samples of a sound, of full scale 1, [samples, channels], and their rate, Hz."""

    samples: FloatArray
    rate_hz: float


def build_sound(
    config: Config, where: str, file: bytes, pixels: str | None, height_m: float, rate_hz: float
) -> FrameSequence:
    """Build pulses of a constant rate, as high as the sound is loud.

    height_m: at the loudest cycle

    Raises InputError (bad_sound, bad_parameter, unknown_pixel, too_many, raises_nothing).
    """
    place = f"{where}: file"
    sound = read_wav(file, place)
    count = int(np.ceil(len(sound.samples) / sound.rate_hz * rate_hz - 1e-9))
    if count > FRAMES_MAX:
        found = Unquoted(f"{count} cycles at {rate_hz:g} Hz")
        raise InputError(place, found, f"at most {FRAMES_MAX} cycles; a lower rate_hz has fewer", code="too_many")
    level = compute_level(sound, rate_hz, count)
    loudest = float(level.max(initial=0.0))
    if loudest < SILENCE:
        raise build_nothing_raised_error(place, "it is silent", "a sound")
    strength = level / loudest
    pulses = [(k / rate_hz, float(each)) for k, each in enumerate(strength) if each >= STRENGTH_MIN]
    return build_pulse_frames(config, where, pulses, pixels, height_m, "sound")


def compute_level(sound: Sound, rate_hz: float, count: int) -> FloatArray:
    """Return the root mean square of each cycle over all channels, [count]."""
    edges = np.minimum(np.round(np.arange(count + 1) * sound.rate_hz / rate_hz).astype(np.int64), len(sound.samples))
    power = np.concatenate([[0.0], np.cumsum((sound.samples**2).mean(axis=1))])
    return np.asarray(np.sqrt(np.diff(power[edges]) / np.maximum(np.diff(edges), 1)), dtype=np.float64)


def read_wav(file: bytes, where: str) -> Sound:
    """Return the samples of a WAV file. Raise InputError (bad_sound, too_many)."""
    if file[:4] != b"RIFF" or file[8:12] != b"WAVE":
        raise InputError(where, file[:12], "a WAV file", code=CODE)
    chunks: dict[bytes, bytes] = {}
    for name, content in _list_chunks(file):
        chunks.setdefault(name, content)
    form, data = chunks.get(b"fmt ", b""), chunks.get(b"data")
    if len(form) < 16 or data is None:
        raise InputError(where, Unquoted("no fmt or no data chunk"), "a WAV file with both", code=CODE)
    kind, channels, rate_hz, _, _, bits = struct.unpack("<HHIIHH", form[:16])
    if kind == EXTENSIBLE and len(form) >= 26:
        (kind,) = struct.unpack("<H", form[24:26])
    if (kind, bits) not in [*((INTEGER, each) for each in (8, 16, 24, 32)), (FLOAT, 32), (FLOAT, 64)]:
        found = Unquoted(f"format {kind} of {bits} bits")
        raise InputError(where, found, "integers of 8, 16, 24 or 32 bits, or floats of 32 or 64", code=CODE)
    if not channels or not rate_hz:
        raise InputError(where, Unquoted(f"{channels} channels at {rate_hz} Hz"), "at least one of each", code=CODE)
    frame_bytes = channels * bits // 8
    count = len(data) // frame_bytes
    if count * channels > SAMPLES_MAX:
        raise InputError(where, Unquoted(f"{count * channels} samples"), f"at most {SAMPLES_MAX}", code="too_many")
    if not count:
        raise build_nothing_raised_error(where, "it has no samples", "a sound")
    samples = _convert(data[: count * frame_bytes], kind, bits)
    if not np.isfinite(samples).all():
        raise InputError(where, Unquoted("samples that are no numbers"), "finite samples", code=CODE)
    return Sound(samples.reshape(-1, channels), float(rate_hz))


def _list_chunks(file: bytes) -> Iterator[tuple[bytes, bytes]]:
    """List the chunks of a file. The last one may be cut, as of a recording that broke off."""
    at = 12
    while at + 8 <= len(file):
        (size,) = struct.unpack("<I", file[at + 4 : at + 8])
        yield file[at : at + 4], file[at + 8 : at + 8 + size]
        at += 8 + size + size % 2


def _convert(data: bytes, kind: int, bits: int) -> FloatArray:
    """Return samples of full scale 1. Samples of 8 bits have no sign."""
    if kind == FLOAT:
        return np.frombuffer(data, "<f4" if bits == 32 else "<f8").astype(np.float64)
    if bits == 8:
        return (np.frombuffer(data, np.uint8).astype(np.float64) - 128.0) / 128.0
    if bits == 24:
        parts = np.frombuffer(data, np.uint8).reshape(-1, 3).astype(np.int32)
        whole = (parts[:, 0] << 8) | (parts[:, 1] << 16) | (parts[:, 2] << 24)
        return np.asarray(whole / 2.0**31, dtype=np.float64)
    return np.asarray(np.frombuffer(data, f"<i{bits // 8}") / 2.0 ** (bits - 1), dtype=np.float64)
