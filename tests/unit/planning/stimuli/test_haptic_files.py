"""Haptic files with known envelopes, written after their specifications: the membrane's peaks, by solve_ivp, follow."""

import json

import numpy as np
import pytest
from scipy.signal import find_peaks

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.stimuli.pattern_registry import build_pattern
from reference_models.nominal_pixel import height_um

MODEL = DISPLAYS["display-437"]
PIXEL = 218
STEP_S = 2e-4


def build(content, **given):
    file = content if isinstance(content, bytes) else json.dumps(content).encode()
    return build_pattern("haptic-file", {"file": file, **given}, MODEL.config)


def find_membrane_peaks(sequence, pixel=PIXEL):
    """Return the times and heights of the peaks of a pixel under the plan, s and µm."""
    plan = plan_sequence(MODEL, sequence, *MODEL.build_cold_state()).plan
    mine = (plan.pixel == pixel) & (plan.power_w > 0)
    pulses = np.column_stack([plan.start_s, plan.width_s, plan.power_w])[mine]
    t_s = np.arange(0.0, pulses[-1, 0] + 0.05, STEP_S)
    height = height_um(MODEL.pixels.elements[pixel], pulses, t_s)
    at, _ = find_peaks(height, prominence=0.2)
    return t_s[at], height[at]


def haptic(amplitude, frequency=()):
    """Return a .haptic file of breakpoints (time, amplitude[, emphasis amplitude]) and (time, frequency)."""
    points = []
    for time, value, *emphasis in amplitude:
        points.append({"time": time, "amplitude": value})
        if emphasis:
            points[-1]["emphasis"] = {"amplitude": emphasis[0], "frequency": 0.5}
    envelopes = {"amplitude": points, "frequency": [{"time": t, "frequency": f} for t, f in frequency]}
    version = {"major": 1, "minor": 0, "patch": 0}
    return {"version": version, "metadata": {}, "signals": {"continuous": {"envelopes": envelopes}}}


def event(kind, at_s, duration_s=None, **parameters):
    entry = {"Time": at_s, "EventType": kind}
    if duration_s is not None:
        entry["EventDuration"] = duration_s
    entry["EventParameters"] = [{"ParameterID": k, "ParameterValue": v} for k, v in parameters.items()]
    return {"Event": entry}


def curve(name, at_s, *points):
    control = [{"Time": t, "ParameterValue": v} for t, v in points]
    return {"ParameterCurve": {"ParameterID": name, "Time": at_s, "ParameterCurveControlPoints": control}}


def ahap(*entries):
    return {"Version": 1.0, "Pattern": list(entries)}


def band(kind, *effects, low=0, high=1000, **more):
    limits = {"lower_frequency_limit": low, "upper_frequency_limit": high}
    return {"band_type": kind, **limits, "effects": list(effects), **more}


def effect(position, *keyframes, **more):
    keys = ("relative_position", "amplitude_modulation", "frequency_modulation")
    frames = [{k: v for k, v in zip(keys, each, strict=False) if v is not None} for each in keyframes]
    return {"effect_type": "Basis", "position": position, "keyframes": frames, **more}


def hjif(*bands, timescale=1000, gain=1.0, library=(), others=(), **perception):
    channel = {"id": 0, "description": "tip", "gain": gain, "mixing_coefficient": 1, "body_part_mask": 0}
    modality = {"perception_modality": "Vibrotactile", **perception}
    shown = {"id": 0, **modality, "channels": [{**channel, "bands": list(bands)}], "effect_library": list(library)}
    return {"version": "2023", "timescale": timescale, "perceptions": [shown, *others], "syncs": [], "avatars": []}


RAMP = ((0.0, 0.1), (0.4, 1.0), (0.8, 0.1))
"""Breakpoints of the envelope in each format, s and strength."""


@pytest.mark.parametrize(
    "content",
    [
        haptic(RAMP, [(0.0, 1 / 3)]),
        ahap(
            curve("HapticIntensityControl", 0.0, *RAMP),
            event("HapticContinuous", 0.0, 0.8, HapticIntensity=1.0, HapticSharpness=1 / 3),
        ),
        hjif(band("VectorialWave", effect(0, *((round(48e3 * t), v, 50) for t, v in RAMP))), timescale=48_000),
    ],
    ids=["haptic", "ahap", "hjif"],
)
def test_peaks_of_the_membrane_follow_the_envelope_at_its_rate(content):
    """Sharpness and frequency 1/3 are 50 Hz between 25 and 100 Hz."""
    at_s, peak_um = find_membrane_peaks(build(content, height_um=120))
    assert np.diff(at_s) == pytest.approx(0.02, abs=2e-3)
    middle_s = 0.01 + 0.02 * np.arange(40)
    assert peak_um == pytest.approx(120 * np.interp(middle_s, *zip(*RAMP, strict=True)), abs=2.5)


def test_a_rate_that_rises_gives_as_many_peaks_as_its_integral():
    content = ahap(
        curve("HapticSharpnessControl", 0.0, (0.0, -0.5), (1.0, 0.5)),
        event("HapticContinuous", 0.0, 1.0, HapticIntensity=0.5, HapticSharpness=0.5),
    )
    at_s, peak_um = find_membrane_peaks(build(content, height_um=100, low_hz=20, high_hz=80))
    assert len(at_s) == pytest.approx(50, abs=1)
    assert peak_um == pytest.approx(50, abs=1.0)
    for until_s in (0.25, 0.5, 0.75):
        assert (at_s < until_s).sum() == pytest.approx(20 * until_s + 30 * until_s**2, abs=1)


def test_a_step_of_a_control_changes_what_follows_only():
    content = ahap(
        event("HapticContinuous", 0.2, 0.4, HapticIntensity=1.0, HapticSharpness=0.0),
        {"Parameter": {"ParameterID": "HapticIntensityControl", "Time": 0.4, "ParameterValue": 0.5}},
        event("HapticTransient", 0.9, HapticIntensity=0.8, HapticSharpness=1.0),
    )
    at_s, peak_um = find_membrane_peaks(build(content, height_um=80))
    assert at_s[0] == pytest.approx(0.2, abs=0.012)
    assert peak_um == pytest.approx([80] * 5 + [40] * 5 + [32], abs=0.5)
    assert at_s[-1] == pytest.approx(0.9, abs=0.012)


def test_an_emphasis_is_a_tap_at_its_time_around_which_the_vibration_goes_on():
    content = haptic([(0.0, 0.3), (0.33, 0.3, 0.9), (0.7, 0.3)], [(0.0, 0.0)])
    sequence = build(content, height_um=100, low_hz=25)
    starts_s = [each.show_at_s for each in sequence.frames]
    heights_um = [round(1e6 * each.target_m.max(), 6) for each in sequence.frames]
    tap = starts_s.index(0.33)
    assert heights_um[tap] == 90
    assert set(heights_um) == {30, 90}
    gaps_s = np.diff(starts_s)
    assert [k for k, each in enumerate(gaps_s) if abs(each - 0.04) > 5e-4] == [tap - 1]
    assert gaps_s[tap - 1] == pytest.approx(0.05, abs=5e-4)  # 0.28 s; a cycle at 0.32 s would be cut by the tap
    _, peak_um = find_membrane_peaks(sequence)
    assert peak_um == pytest.approx(heights_um, abs=0.7)


def test_overlapping_events_add_up_to_full_strength_at_the_strongest_rate():
    content = ahap(
        event("HapticContinuous", 0.0, 0.5, HapticIntensity=0.3, HapticSharpness=0.0),
        event("HapticContinuous", 0.1, 0.2, HapticIntensity=0.9, HapticSharpness=1.0),
    )
    frames = build(content, height_um=100).frames
    heights = {each.show_at_s: round(1e6 * each.target_m.max(), 6) for each in frames}
    assert {height for at_s, height in heights.items() if 0.12 <= at_s < 0.29} == {100}
    assert {height for at_s, height in heights.items() if at_s < 0.07 or at_s > 0.31} == {30}
    assert np.diff([at_s for at_s in heights if 0.12 < at_s < 0.29]) == pytest.approx(0.01, abs=1e-3)


def test_bands_references_taps_and_the_gain_of_an_interchange_file():
    library = [effect(0, (0, 1.0, 40), (500, 1.0, 40), id=7)]
    content = hjif(
        band("VectorialWave", {"effect_type": "Reference", "id": 7, "position": 100}),
        band("Transient", effect(1000, (0, 0.5), (200, 1.0))),
        gain=0.5,
        library=library,
    )
    at_s, peak_um = find_membrane_peaks(build(content, height_um=100))
    assert peak_um == pytest.approx([50] * 20 + [25, 50], abs=0.5)
    assert at_s[[0, -2, -1]] == pytest.approx([0.1, 1.0, 1.2], abs=0.012)
    assert np.diff(at_s[1:20]) == pytest.approx(0.025, abs=1e-3)  # the first pulse, on a cold pixel, is longer


@pytest.mark.parametrize("kind", ["Linear", "Cubic"])
def test_a_curve_is_drawn_by_its_upper_half(kind):
    content = hjif(band("Curve", effect(0, (0, 0.0), (400, 0.8), (800, 0.0)), high=50, curve_type=kind))
    frames = build(content, height_um=100).frames
    middle_s = np.array([each.show_at_s for each in frames]) + 0.005
    share = np.interp(middle_s, [0, 0.4, 0.8], [0, 1, 0])
    expected = 80 * (share if kind == "Linear" else 3 * share**2 - 2 * share**3)
    assert [1e6 * each.target_m.max() for each in frames] == pytest.approx(expected, abs=0.2)
    assert np.diff(middle_s) == pytest.approx(0.01, abs=1e-5)


def test_several_pixels_rise_together_and_the_channel_of_several_is_stated():
    frames = build(haptic([(0.0, 1.0), (0.2, 1.0)]), pixels="20, 30-32", height_um=50).frames
    for frame in frames:
        assert np.flatnonzero(frame.target_m).tolist() == [20, 30, 31, 32]
    content = hjif(band("Transient", effect(0, (0, 0.4))))
    second = json.loads(json.dumps(content["perceptions"][0]))
    second["channels"][0] |= {"description": "palm", "bands": [band("Transient", effect(0, (0, 0.7)))]}
    content["perceptions"].append(second)
    with pytest.raises(InputError, match=r"channel: missing, expected one of .* 1 \(tip\), 2 \(palm\)"):
        build(content)
    assert build(content, channel=2, height_um=100).frames[0].target_m.max() == pytest.approx(70e-6)


NOT_SHOWN = {
    "sound": (
        ahap(
            event("AudioCustom", 0.0),
            event("AudioContinuous", 0.0, 1.0),
            event("HapticTransient", 0.0, HapticIntensity=0.5),
        ),
        "2 parts beyond it, expected what a membrane shows, or lossy=true to show the rest; it cannot show "
        "1 × AudioCustom (a membrane makes no sound); 1 × AudioContinuous (a membrane makes no sound)",
        50,
    ),
    "times of an envelope": (
        ahap(event("HapticContinuous", 0.0, 0.1, HapticIntensity=0.5, HapticSharpness=0, AttackTime=0.3, Sustained=0)),
        "1 × AttackTime (no document states its time); 1 × Sustained (no document states its time)",
        50,
    ),
    "control of an envelope": (
        ahap(curve("HapticReleaseTimeControl", 0, (0, 1)), event("HapticTransient", 0.0, HapticIntensity=0.5)),
        "1 × HapticReleaseTimeControl",
        50,
    ),
    "rate": (
        hjif(band("VectorialWave", effect(0, (0, 0.5, 300), (100, 0.5, 300)))),
        "1 × rates above 200 Hz, which become 200 Hz",
        50,
    ),
    "waves without frequency": (
        hjif(band("VectorialWave", effect(0, (0, 0.5), (100, 0.5)))),
        "1 × rates below 1 Hz, which become 1 Hz",
        None,
    ),
    "coded waves": (
        hjif(band("WaveletWave", {"effect_type": "Basis", "position": 0}), band("Transient", effect(0, (0, 0.5)))),
        "1 × WaveletWave band (coded waves)",
        50,
    ),
    "composite": (
        hjif(band("Transient", {"effect_type": "Composite", "position": 0}, effect(0, (0, 0.5)))),
        "1 × Composite effect",
        50,
    ),
    "shape": (
        hjif(band("VectorialWave", effect(0, (0, 0.5, 50), (100, 0.5, 50), base_signal="Square"))),
        "1 × base_signal Square (a pulse has one shape)",
        50,
    ),
    "lower half": (
        hjif(band("Curve", effect(0, (0, 0.5), (60, 0.5), (61, -1.0), (100, -1.0)), high=50, curve_type="Linear")),
        "1 × lower half of a Curve (a membrane only rises)",
        50,
    ),
    "warmth": (
        hjif(
            band("Transient", effect(0, (0, 0.5))),
            others=[{"id": 1, "perception_modality": "Temperature", "channels": []}],
        ),
        "1 × perception Temperature (a membrane vibrates)",
        50,
    ),
}


@pytest.mark.parametrize("name", NOT_SHOWN)
def test_what_a_membrane_cannot_show_is_named_and_the_rest_shown_on_request(name):
    content, named, height_um = NOT_SHOWN[name]
    with pytest.raises(InputError) as refused:
        build(content)
    assert refused.value.code == "not_shown"
    assert named in str(refused.value)
    assert "\n" not in str(refused.value)
    if height_um is not None:
        assert 1e6 * build(content, lossy=True).frames[0].target_m.max() == pytest.approx(height_um)


GOOD = [(0.0, 0.5), (0.1, 0.5)]
BAD = {
    "no JSON": (b"RIFF", "bad_json", "expected valid JSON"),
    "other members": (
        {"a": 1},
        "bad_haptic",
        "got members a, expected signals (.haptic), Pattern (AHAP) or perceptions",
    ),
    "no object": ([1], "bad_haptic", "got [1], expected an object"),
    "version 2": (haptic(GOOD) | {"version": {"major": 2}}, "bad_haptic", "version.major: got 2, expected 1"),
    "one breakpoint": (haptic(GOOD[:1]), "bad_haptic", "amplitude: got 1, expected at least two breakpoints"),
    "earlier": (haptic([*GOOD, (0.05, 0.1)]), "bad_haptic", "amplitude[2].time: got 0.05, expected a time not before"),
    "above 1": (haptic([*GOOD, (0.2, 1.5)]), "bad_haptic", "amplitude[2].amplitude: got 1.5, expected a number from 0"),
    "weak emphasis": (haptic([(0.0, 0.5, 0.4), GOOD[1]]), "bad_haptic", "emphasis.amplitude: got 0.4, expected a"),
    "late frequency": (haptic(GOOD, [(0.2, 0)]), "bad_haptic", "frequency: got 0.2, expected none after the last"),
    "too long": (haptic([(0.0, 0.5), (900.0, 0.5)]), "bad_haptic", "time: got 900.0, expected a number from 0 to 600"),
    "too many cycles": (
        haptic([(0.0, 0.5), (101.0, 0.5)], [(0.0, 1.0)]),
        "too_many",
        "within 100.0 s, expected at most 10000 cycles and taps",
    ),
    "unknown event": (ahap(event("Buzz", 0)), "bad_haptic", "Pattern[0].Event.EventType: got 'Buzz', expected one of"),
    "no intensity": (ahap(event("HapticTransient", 0)), "bad_haptic", "HapticIntensity: missing, expected this"),
    "no duration": (
        ahap(event("HapticContinuous", 0, HapticIntensity=1, HapticSharpness=1)),
        "bad_haptic",
        "EventDuration: missing",
    ),
    "silent": (ahap(event("HapticTransient", 0, HapticIntensity=0)), "raises_nothing", "its strength is below 0.01"),
    "no band type": (hjif({"effects": []}), "bad_haptic", "bands[0].band_type: missing"),
    "lost reference": (
        hjif(band("Transient", {"effect_type": "Reference", "id": 3, "position": 0})),
        "bad_haptic",
        "got 3, expected an effect of effect_library",
    ),
    "tap without strength": (hjif(band("Transient", effect(0, (0,)))), "bad_haptic", "an amplitude_modulation of each"),
    "ticks": (hjif(timescale=0), "bad_haptic", "timescale: got 0.0, expected 1 to 48000"),
    "before its start": (hjif(band("Transient", effect(-5, (0, 1.0)))), "bad_haptic", "a position within 600 s"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_file_that_is_not_as_its_format_says_is_refused_by_place(name):
    content, code, says = BAD[name]
    with pytest.raises(InputError) as refused:
        build(content)
    assert refused.value.code == code
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("given", "code", "says"),
    [
        ({"pixels": "437"}, "unknown_pixel", "pixels: got '437', expected pixels, 0…436"),
        ({"pixels": "5-3"}, "unknown_pixel", "in increasing order"),
        ({"pixels": "1;2"}, "bad_parameter", "got '1;2', expected pixels such as 200,201 or 200-205"),
        ({"low_hz": 90, "high_hz": 50}, "bad_parameter", "high_hz: got 50.0, expected at least low_hz, 90 Hz"),
        ({"channel": 2}, "bad_parameter", "channel: got 2, expected 1"),
    ],
)
def test_wrong_parameters_are_refused(given, code, says):
    with pytest.raises(InputError) as refused:
        build(haptic(GOOD), **given)
    assert refused.value.code == code
    assert says in str(refused.value)
