"""Registry of the named patterns that `play` and the REST API offer."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import cache

import numpy as np
from pydantic import TypeAdapter

from optodrive.core.errors import InputError, OptodriveError, build_nothing_raised_error, suggest_nearest
from optodrive.core.plug_ins import PlugIns, find_plug_ins
from optodrive.core.types.stimuli import FrameSequence, HeightTrain
from optodrive.device.config import Config
from optodrive.planning.stimuli import experiments, images, shapes
from optodrive.planning.stimuli.braille_files import build_braille_file
from optodrive.planning.stimuli.drawings import build_drawing
from optodrive.planning.stimuli.experiments import build_comparison
from optodrive.planning.stimuli.imports.haptic_files import build_haptic_file
from optodrive.planning.stimuli.imports.sound import build_sound
from optodrive.planning.stimuli.intensity import IntensityModel
from optodrive.planning.stimuli.pattern import Pattern, PatternDescription, PatternParameter
from optodrive.planning.stimuli.sequence_file import (
    parse_sequence,
    raises_nothing,
    sequence_to_json,
    validate_sequence,
)
from optodrive.planning.stimuli.shapes import build_showcase
from optodrive.planning.stimuli.text import PAGES_MAX, build_text

_CENTRE_PARAMETER = PatternParameter(
    "centre", "pixel", None, "pixel at the centre of the stimulus; the display's middle by default"
)
_SECONDS_PARAMETER = PatternParameter("seconds", "number", 1.0, "minimum duration", "s", min=0.0, max=600.0)
_INTENSITY_PARAMETER = PatternParameter(
    "intensity", "number", None, "perceived intensity in thresholds, in place of height_um", min=0.01, max=1000.0
)
_PIXELS_PARAMETER = PatternParameter(
    "pixels", "text", None, "pixels that rise together, such as 200,201 or 200-205; the middle by default"
)
_FILE_PARAMETER = PatternParameter("file", "file", None, "image file: PNG, JPEG or GIF", required=True)
_INVERT_PARAMETER = PatternParameter("invert", "flag", False, "raise dark areas instead of bright ones")
_DIRECTION_PARAMETER = PatternParameter(
    "direction", "choice", "right", "direction of motion, seen from above", choices=tuple(experiments.DIRECTIONS)
)


def _height_parameter(default_um: float, description: str = "peak height of a raised pixel") -> PatternParameter:
    return PatternParameter("height_um", "number", default_um, description, "µm", min=1.0, max=1000.0)


def _intensity_parameter(name: str) -> PatternParameter:
    return PatternParameter(name, "number", 6.0, "perceived intensity in thresholds", min=0.01, max=1000.0)


def _size_parameter(name: str, description: str) -> PatternParameter:
    return PatternParameter(name, "number", None, description, "mm", min=0.0, max=1000.0)


def _integer_parameter(name: str, default: int, description: str, minimum: int, maximum: int) -> PatternParameter:
    return PatternParameter(name, "integer", default, description, min=minimum, max=maximum)


def _time_parameter(name: str, default_s: float, description: str) -> PatternParameter:
    return PatternParameter(name, "number", default_s, description, "s", min=0.0, max=60.0)


def _choice_parameter(name: str, default: str, description: str, choices: tuple[str, ...]) -> PatternParameter:
    return PatternParameter(name, "choice", default, description, choices=choices)


_RADIUS_PARAMETER = _size_parameter("radius_mm", "radius of the ring; 0.6 of the distance to the border by default")
_DIGIT_PAIRS = ("2-3", "2-4", "2-5", "3-4", "3-5", "4-5")

_PATTERN_LIST = (
    Pattern(
        "experiment-1",
        "linear motion: three pixels in a row, twice",
        (_DIRECTION_PARAMETER, _CENTRE_PARAMETER),
        experiments.build_linear_motion,
        "300 ms per pixel at 20 ms on, 60 ms off; 500 ms between the two passes.",
        policy="refuse",
    ),
    Pattern(
        "experiment-2",
        "rotational motion: eight pixels around a centre",
        (
            _choice_parameter("direction", "cw", "clockwise or counterclockwise, seen from above", ("cw", "ccw")),
            _choice_parameter(
                "speed", "16", "speed in mm/s as in the paper: 200, 100 or 50 ms per pixel", tuple(experiments.SPEEDS_S)
            ),
            _CENTRE_PARAMETER,
        ),
        experiments.build_rotation,
        "25 ms on, 71 ms off, whole pulses only: two per pixel at 16 mm/s, one at 32 and 64. "
        "The paper does not state the number of turns; one is shown.",
        policy="refuse",
    ),
    Pattern(
        "experiment-3",
        "localisation: the centre as reference, then one of 3 × 3",
        (
            _integer_parameter("target", 5, "place in the grid, numbered by rows from the top left", 1, 9),
            _CENTRE_PARAMETER,
        ),
        experiments.build_localisation,
        "500 ms each at 25 ms on, 25 ms off; 750 ms between. The paper does not state the numbering.",
        policy="refuse",
    ),
    Pattern(
        "experiment-4",
        "intensity: one pixel for a second, at one of nine powers",
        (_integer_parameter("level", 5, "power, 0.5 W to 2.5 W in steps of 0.25 W", 1, 9), _CENTRE_PARAMETER),
        experiments.build_intensity,
        "25 ms on, 25 ms off. A level above the laser's maximum power plays at the maximum: level 9, 2.5 W, at 2.45 W.",
        policy="refuse",
    ),
    Pattern(
        "experiment-5",
        "temporal pattern: three stimuli of 400 ms, one of them odd",
        (
            _integer_parameter("oddball", 1, "position of the odd stimulus", 1, 3),
            _choice_parameter(
                "kind", "fast", "pulses of the odd stimulus: slow 35/35 ms, fast 10/10 ms", ("slow", "fast")
            ),
            _time_parameter("pause_s", 0.5, "pause between stimuli; not stated in the paper"),
            _CENTRE_PARAMETER,
        ),
        experiments.build_temporal_pattern,
        policy="refuse",
    ),
    Pattern(
        "experiment-6",
        "multi-point: squares of four pixels under two fingers at once",
        (_choice_parameter("digits", "2-3", "the two fingers; 2 is the index finger", _DIGIT_PAIRS), _CENTRE_PARAMETER),
        experiments.build_two_fingers,
        "40 pulses of 15 ms, the two fingers alternating; 600 ms, and with one stage the settling times. "
        "The paper does not state the positions of the fingers or the order within a square.",
        policy="refuse",
    ),
    Pattern(
        "detection",
        "one of two pixels, left or right of a centre, at a power that may be too weak to be felt",
        (
            _choice_parameter("side", "left", "which of the two", ("left", "right")),
            PatternParameter("power_mw", "number", 500.0, "power of the pulses", "mW", min=1.0, max=5000.0),
            _CENTRE_PARAMETER,
        ),
        experiments.build_detection,
        "500 ms at 25 ms on, 25 ms off, three pitches from the centre. A power above the laser's plays at the laser's.",
        policy="refuse",
    ),
    Pattern(
        "comparison",
        "two places one after the other, whose intensities are compared",
        (
            PatternParameter("first", "pixel", None, "pixel that vibrates first; the middle by default"),
            PatternParameter("second", "pixel", None, "pixel that vibrates second; the middle by default"),
            _intensity_parameter("first_intensity"),
            _intensity_parameter("second_intensity"),
        ),
        build_comparison,
        "400 ms each at 25 Hz, 400 ms between. Intensities are those of a person of sensitivity 1 everywhere.",
        policy="refuse",
    ),
    Pattern("showcase", "a moving dot, a ring, braille, two pairs of fingers", (), build_showcase),
    Pattern(
        "pixel",
        "one pixel, up and down",
        (
            PatternParameter("pixel", "pixel", None, "index of the pixel; the middle by default"),
            _height_parameter(100.0),
            _INTENSITY_PARAMETER,
            _SECONDS_PARAMETER,
        ),
        shapes.build_single_pixel,
    ),
    Pattern(
        "vibration",
        "one pixel that vibrates at one height, each pulse planned from the current thermal state",
        (
            PatternParameter("pixel", "pixel", None, "index of the pixel; the middle by default"),
            _height_parameter(200.0, "height of every peak"),
            _INTENSITY_PARAMETER,
            PatternParameter(
                "peak_to_peak_um",
                "number",
                None,
                "fall between peaks; by default that of the shortest pulses, which need the least energy",
                "µm",
                min=0.5,
                max=1000.0,
            ),
            PatternParameter("rate_hz", "number", 25.0, "peaks per second", "Hz", min=0.1, max=200.0),
            PatternParameter("seconds", "number", 1.0, "duration", "s", min=0.01, max=600.0),
        ),
        shapes.build_vibration,
        "The peak-to-peak range for a rate and a height depends on the pixel; the error message states it.",
    ),
    Pattern(
        "all",
        "every pixel",
        (_height_parameter(50.0), _INTENSITY_PARAMETER, _SECONDS_PARAMETER),
        shapes.build_all_pixels,
    ),
    Pattern(
        "checker",
        "every other pixel",
        (_height_parameter(50.0), _INTENSITY_PARAMETER, _SECONDS_PARAMETER),
        shapes.build_checkerboard,
    ),
    Pattern(
        "circle",
        "a ring",
        (_RADIUS_PARAMETER, _height_parameter(100.0), _INTENSITY_PARAMETER, _SECONDS_PARAMETER),
        shapes.build_ring,
    ),
    Pattern(
        "square",
        "the outline of a square",
        (
            _size_parameter("side_mm", "length of a side; 0.6 of the display by default"),
            _height_parameter(100.0),
            _INTENSITY_PARAMETER,
            _SECONDS_PARAMETER,
        ),
        shapes.build_square_outline,
    ),
    Pattern(
        "edge",
        "a line that moves across the display",
        (
            _DIRECTION_PARAMETER,
            _height_parameter(50.0),
            _INTENSITY_PARAMETER,
            _time_parameter("step_s", 0.1, "time per pitch, or the beam time if longer"),
        ),
        shapes.build_moving_edge,
    ),
    Pattern(
        "dot",
        "one pixel that moves along a ring, clockwise",
        (
            _RADIUS_PARAMETER,
            _height_parameter(200.0),
            _INTENSITY_PARAMETER,
            _time_parameter("step_s", 0.06, "time per pixel, or the beam time if longer"),
            _integer_parameter("turns", 1, "number of turns", 1, 100),
        ),
        shapes.build_moving_dot,
    ),
    Pattern(
        "text",
        "text in braille: uncontracted English, or by a table of liblouis",
        (
            PatternParameter("text", "text", None, "text to show", required=True),
            _height_parameter(150.0, "peak height of a dot"),
            _INTENSITY_PARAMETER,
            PatternParameter("seconds", "number", 2.0, "minimum time per page", "s", min=0.0, max=600.0),
            _integer_parameter("dot_step", 1, "pitches between the dots of a cell", 1, 10),
            _integer_parameter("cell_gap", 1, "empty columns between cells", 0, 20),
            _integer_parameter("line_gap", 1, "empty rows between lines", 0, 20),
            PatternParameter("table", "text", None, "table of liblouis, such as en-ueb-g2 or de-g1"),
        ),
        build_text,
    ),
    Pattern(
        "image",
        "an image, bright is high",
        (_FILE_PARAMETER, _height_parameter(50.0, "height of white"), _SECONDS_PARAMETER, _INVERT_PARAMETER),
        images.build_image,
    ),
    Pattern(
        "drawing",
        "an SVG drawing with lines at three heights, by class: grid, axes, curve; or an ILDA file",
        (
            PatternParameter("file", "file", None, "SVG or ILDA file", required=True),
            _height_parameter(90.0, "height of class curve; axes two thirds, grid one third"),
            _SECONDS_PARAMETER,
        ),
        build_drawing,
    ),
    Pattern(
        "braille-file",
        "pages of braille: a BRF or PEF file, or one of text",
        (
            PatternParameter("file", "file", None, "BRF or PEF file, or one of text", required=True),
            _height_parameter(150.0, "peak height of a dot"),
            _INTENSITY_PARAMETER,
            PatternParameter("seconds", "number", 2.0, "minimum time per page", "s", min=0.0, max=600.0),
            _choice_parameter("format", "auto", "what the file holds", ("auto", "braille", "text")),
            PatternParameter("table", "text", None, "table of liblouis, for text"),
            _integer_parameter("start_page", 1, "first page of the file that is shown", 1, PAGES_MAX),
            PatternParameter(
                "pages", "integer", None, "number of them; all from there by default", min=1, max=PAGES_MAX
            ),
        ),
        build_braille_file,
    ),
    Pattern(
        "animation",
        "an animated GIF or PNG, bright is high",
        (
            _FILE_PARAMETER,
            _height_parameter(50.0, "height of white"),
            PatternParameter(
                "rate_hz",
                "number",
                None,
                "images per second; by default the file's durations, extended to the beam time",
                "Hz",
                min=0.01,
                max=50.0,
            ),
            _INVERT_PARAMETER,
        ),
        images.build_animation,
    ),
    Pattern(
        "haptic-file",
        "taps and vibrations of a haptic file: .haptic, AHAP or .hjif",
        (
            PatternParameter("file", "file", None, ".haptic, AHAP or .hjif file", required=True),
            _PIXELS_PARAMETER,
            _height_parameter(100.0, "height of strength 1"),
            PatternParameter("low_hz", "number", 25.0, "rate of frequency or sharpness 0", "Hz", min=1.0, max=200.0),
            PatternParameter("high_hz", "number", 100.0, "rate of frequency or sharpness 1", "Hz", min=1.0, max=200.0),
            PatternParameter("channel", "integer", None, "channel of a .hjif file with several", min=1, max=65_536),
            PatternParameter("lossy", "flag", False, "leave out what a membrane cannot show, instead of refusing it"),
        ),
        build_haptic_file,
        "One pulse per cycle and pixel, of the envelope's height. Frequencies of a .hjif file are in Hz, up to 200.",
    ),
    Pattern(
        "sound",
        "pulses as high as a sound is loud",
        (
            PatternParameter("file", "file", None, "WAV file", required=True),
            _PIXELS_PARAMETER,
            _height_parameter(100.0, "height of the loudest cycle"),
            PatternParameter("rate_hz", "number", 50.0, "pulses per second", "Hz", min=1.0, max=200.0),
        ),
        build_sound,
        "The height of a pulse is the root mean square of its cycle, over all channels.",
    ),
    Pattern(
        "scope",
        "a waveform on the converter's outputs for an oscilloscope, with weak pulses of 1 ms",
        (
            _choice_parameter("waveform", "steps-x", "steps, square or ramp", experiments.WAVEFORMS),
            PatternParameter("dwell_s", "number", 0.02, "time at each place", "s", min=0.005, max=1.0),
            PatternParameter("power_mw", "number", 25.0, "power of the pulses", "mW", min=0.1, max=50.0),
            PatternParameter("seconds", "number", 10.0, "duration, in whole periods", "s", min=0.1, max=60.0),
        ),
        experiments.build_scope_waveform,
        "Steps are between the ends of the middle row or column, the square between the corners of the display; a ramp "
        "visits the middle row or column pixel by pixel.",
    ),
)

PATTERNS: dict[str, Pattern] = {pattern.name: pattern for pattern in _PATTERN_LIST}


PLUG_INS = "optodrive.patterns"
"""Group of the entry points by which other packages offer patterns."""


@cache
def load_plug_ins() -> PlugIns[Pattern]:
    """Return the patterns of other packages."""
    return find_plug_ins(PLUG_INS, _check_plug_in)


def _check_plug_in(name: str, pattern: object, package: str) -> Pattern:
    """Return a pattern whose builder's errors are told, and whose sequence is checked as that of a file."""
    if not isinstance(pattern, Pattern) or pattern.name != name:
        raise TypeError(f"a Pattern of the entry point's name {name} is expected")
    if name in PATTERNS:
        raise ValueError("another pattern has this name")
    TypeAdapter(PatternDescription).validate_python(asdict(_describe_pattern(pattern)))

    def build(config: Config, where: str, **arguments: object) -> FrameSequence:
        try:
            return parse_sequence(sequence_to_json(pattern.build(config, where, **arguments)), config, where)
        except OptodriveError:
            raise
        except Exception as error:  # the code of others
            raise OptodriveError(f"{where} of {package}: {type(error).__name__}: {error}") from None

    return replace(pattern, build=build)


def find_pattern(name: str) -> Pattern:
    """Return the pattern of a name.

    Raise InputError: unknown_pattern with the nearest known name; broken_plug_in.
    """
    if name in PATTERNS:
        return PATTERNS[name]
    plug_ins = load_plug_ins()
    if name in plug_ins.broken:
        raise InputError("pattern", name, f"one that can be used ({plug_ins.broken[name]})", code="broken_plug_in")
    if name not in plug_ins.found:
        expected = f"a known pattern, {suggest_nearest(name[:60], [*PATTERNS, *plug_ins.found])}"
        raise InputError("pattern", name, expected, code="unknown_pattern")
    return plug_ins.found[name]


def build_pattern(name: str, given: object, config: Config) -> FrameSequence:
    """Build a pattern's sequence for a display. `given` maps parameters to values.

    A value may be text, as from a command line; a file is its bytes, or these in base64.

    Raises InputError: unknown_pattern, unknown_parameter, missing_parameter, bad_parameter, unknown_pixel,
    does_not_fit, bad_text, bad_picture, bad_haptic, bad_sound, not_shown, too_many, bad_train, raises_nothing.
    """
    pattern, where = find_pattern(name), f"pattern {name}"
    arguments = pattern.resolve_arguments(given, config)
    if arguments.pop("intensity", None) is None:
        sequence = pattern.build(config, where, **arguments)
    else:
        sequence = _build_by_intensity(pattern, where, given, config)
    if raises_nothing(sequence):
        raise build_nothing_raised_error(where, "it meets no pixel of the display", "one that meets a pixel")
    return validate_sequence(sequence, where, config)


def _build_by_intensity(pattern: Pattern, where: str, given: object, config: Config) -> FrameSequence:
    """Build a pattern all of whose raised pixels have one height, with the heights of one intensity."""
    arguments, place = pattern.resolve_arguments(given, config), f"{where}: intensity"
    intensity = float(str(arguments.pop("intensity")))
    for name in ("height_um", "peak_to_peak_um"):
        if isinstance(given, Mapping) and name in given:
            raise InputError(f"{where}: {name}", given[name], "none beside an intensity", code="bad_parameter")
    model, sequence = IntensityModel(config), pattern.build(config, where, **arguments)
    if sequence.trains:
        trains = [
            replace(each, target_m=model.solve_train_m(each.pixel, each.period_s, each.duration_s, intensity, place))
            for each in sequence.trains
            if isinstance(each, HeightTrain)
        ]
        return FrameSequence(trains=tuple(trains))
    is_raised = np.any([frame.target_m > 0.0 for frame in sequence.frames], axis=0)
    target_m = model.solve_targets_m(np.where(is_raised, intensity, 0.0), place)
    # Frames last as long as the beam needs for the highest pixel at every place.
    sequence = pattern.build(config, where, **{**arguments, "height_m": float(target_m.max())})
    frames = [replace(frame, target_m=np.where(frame.target_m > 0.0, target_m, 0.0)) for frame in sequence.frames]
    return FrameSequence(tuple(frames))


def describe_patterns() -> list[PatternDescription]:
    """Describe every pattern and its parameters, those of other packages last."""
    return [_describe_pattern(pattern) for pattern in (*_PATTERN_LIST, *load_plug_ins().found.values())]


def _describe_pattern(pattern: Pattern) -> PatternDescription:
    return PatternDescription(pattern.name, pattern.summary, pattern.notes, pattern.parameters, pattern.policy)
