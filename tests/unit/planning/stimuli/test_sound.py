"""Sounds with known envelopes, written by the standard library and SciPy: the membrane's peaks follow them."""

import io
import struct
import wave

import numpy as np
import pytest
from scipy.io import wavfile
from scipy.signal import find_peaks

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.stimuli.pattern_registry import build_pattern
from reference_models.nominal_pixel import height_um

MODEL = DISPLAYS["display-437"]
PIXEL, RATE_HZ = 218, 8000


def envelope(t_s):
    return np.interp(t_s, [0.0, 0.5, 1.0], [0.1, 1.0, 0.1])


def tone(loudness=0.5):
    """Return a second of a tone of 1 kHz under the envelope, of full scale 1."""
    t_s = np.arange(RATE_HZ) / RATE_HZ
    return loudness * envelope(t_s) * np.sin(2000 * np.pi * t_s)


def write_integers(samples, width):
    """Return a WAV file by the standard library; samples [n] or [n, channels]."""
    table = samples[:, None] if samples.ndim == 1 else samples
    whole = np.round(table * (2 ** (8 * width - 1) - 1)).astype(np.int64) + (128 if width == 1 else 0)
    content = b"".join(int(each).to_bytes(width, "little", signed=width > 1) for each in whole.ravel())
    buffer = io.BytesIO()
    with wave.open(buffer, "wb") as file:
        file.setnchannels(table.shape[1])
        file.setsampwidth(width)
        file.setframerate(RATE_HZ)
        file.writeframes(content)
    return buffer.getvalue()


def write_by_scipy(samples):
    buffer = io.BytesIO()
    wavfile.write(buffer, RATE_HZ, samples)
    return buffer.getvalue()


def extend(file):
    """Return a file of 16 bits in the extensible form, as recorders write more than two channels or 24 bits."""
    channels, rate, _, block, bits = struct.unpack("<HIIHH", file[22:36])
    guid = struct.pack("<H", 1) + bytes.fromhex("000000001000800000aa00389b71")
    form = struct.pack("<HHIIHH", 0xFFFE, channels, rate, rate * block, block, bits)
    chunk = b"fmt " + struct.pack("<I", 40) + form + struct.pack("<HHI", 22, bits, 4) + guid
    odd = b"LIST" + struct.pack("<I", 3) + b"abc\0"
    body = b"WAVE" + odd + chunk + file[36:]
    return b"RIFF" + struct.pack("<I", len(body)) + body


def build(file, **given):
    return build_pattern("sound", {"file": file, **given}, MODEL.config)


def list_heights_um(sequence):
    return np.array([1e6 * each.target_m.max() for each in sequence.frames])


def test_peaks_of_the_membrane_follow_the_envelope_of_the_sound():
    sequence = build(write_integers(tone(), 2), height_um=120, rate_hz=40, pixels=str(PIXEL))
    plan = plan_sequence(MODEL, sequence, *MODEL.build_cold_state()).plan
    pulses = np.column_stack([plan.start_s, plan.width_s, plan.power_w])
    t_s = np.arange(0.0, 1.05, 2e-4)
    height = height_um(MODEL.pixels.elements[PIXEL], pulses, t_s)
    at, _ = find_peaks(height, prominence=0.2)
    cycles_s = 0.025 * np.arange(40) + 0.0125
    loudest = envelope(cycles_s).max()
    assert height[at] == pytest.approx(120 * envelope(cycles_s) / loudest, abs=2.0)
    assert np.diff(t_s[at]) == pytest.approx(0.025, abs=2e-3)


def test_every_width_of_samples_gives_the_same_heights():
    expected = list_heights_um(build(write_by_scipy(tone())))
    assert len(expected) == 50
    files = {
        "16": write_integers(tone(), 2),
        "24": write_integers(tone(), 3),
        "32": write_integers(tone(), 4),
        "float": write_by_scipy(tone().astype(np.float32)),
        "extensible": extend(write_integers(tone(), 2)),
        "cut": write_integers(np.concatenate([tone(), tone()]), 2)[: 44 + 2 * RATE_HZ],
    }
    for name, file in files.items():
        assert list_heights_um(build(file)) == pytest.approx(expected, abs=0.05), name
    assert list_heights_um(build(write_integers(tone(), 1))) == pytest.approx(expected, abs=1.5)


def test_a_quiet_sound_is_as_high_and_two_channels_count_by_their_power():
    expected = list_heights_um(build(write_by_scipy(tone())))
    assert list_heights_um(build(write_by_scipy(tone(0.01)))) == pytest.approx(expected)
    opposite = np.column_stack([tone(), -tone()])  # their sum is silence
    assert list_heights_um(build(write_by_scipy(opposite))) == pytest.approx(expected)


def test_pauses_have_no_pulses():
    sound = np.concatenate([tone(), np.zeros(RATE_HZ), tone()])
    starts_s = np.array([each.show_at_s for each in build(write_by_scipy(sound)).frames])
    assert len(starts_s) == 100
    assert not ((starts_s > 0.99) & (starts_s < 1.99)).any()


BAD = {
    "no WAV": (b"OggS" + bytes(40), "bad_sound", "expected a WAV file"),
    "no data": (write_integers(tone(), 2)[:36], "bad_sound", "got no fmt or no data chunk"),
    "empty": (write_integers(np.zeros(0), 2), "raises_nothing", "it has no samples"),
    "silent": (write_integers(np.zeros(800), 2), "raises_nothing", "it is silent"),
    "µ-law": (
        write_by_scipy(tone())[:20] + b"\x07\0" + write_by_scipy(tone())[22:],
        "bad_sound",
        "format 7 of 64 bits",
    ),
    "no numbers": (write_by_scipy(np.full(800, np.nan)), "bad_sound", "samples that are no numbers"),
    "too long": (
        write_integers(np.ones(300 * 100), 1)[:24]
        + struct.pack("<I", 100)
        + bytes(4)
        + b"\1\0\x08\0data"
        + struct.pack("<I", 30_000)
        + bytes(30_000),
        "too_many",
        "15000 cycles at 50 Hz",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_file_without_a_sound_is_refused(name):
    file, code, says = BAD[name]
    with pytest.raises(InputError) as refused:
        build(file)
    assert refused.value.code == code
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)
