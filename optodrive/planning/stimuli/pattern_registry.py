"""The registry of named patterns: what `play` and the patterns of the REST face offer."""

from dataclasses import asdict
from typing import Any

from optodrive.core.errors import InputError, suggest_nearest
from optodrive.core.types.stimuli import FrameSequence
from optodrive.device.config import Config
from optodrive.planning.stimuli import experiments, images, shapes
from optodrive.planning.stimuli.pattern import Pattern, PatternParameter
from optodrive.planning.stimuli.sequence_file import validate_sequence
from optodrive.planning.stimuli.showcase import build_showcase
from optodrive.planning.stimuli.text import build_text

_CENTRE_PARAMETER = PatternParameter(
    "centre", "pixel", None, "pixel at the stimulus' centre; the display's middle if not given"
)
_SECONDS_PARAMETER = PatternParameter(
    "seconds", "number", 1.0, "how long it is kept up, at least", "s", min=0.0, max=600.0
)
_FILE_PARAMETER = PatternParameter("file", "file", None, "the picture: PNG, JPEG or GIF", required=True)
_INVERT_PARAMETER = PatternParameter("invert", "flag", False, "raise what is dark instead of what is bright")
_DIRECTION_PARAMETER = PatternParameter(
    "direction", "choice", "right", "where it moves, seen from above", choices=tuple(experiments.DIRECTIONS)
)


def _height_parameter(default_um: float, description: str = "peak height of a raised pixel") -> PatternParameter:
    return PatternParameter("height_um", "number", default_um, description, "µm", min=0.1, max=1000.0)


def _size_parameter(name: str, description: str) -> PatternParameter:
    return PatternParameter(name, "number", None, description, "mm", min=0.0, max=1000.0)


def _integer_parameter(name: str, default: int, description: str, minimum: int, maximum: int) -> PatternParameter:
    return PatternParameter(name, "integer", default, description, min=minimum, max=maximum)


def _time_parameter(name: str, default_s: float, description: str) -> PatternParameter:
    return PatternParameter(name, "number", default_s, description, "s", min=0.0, max=60.0)


def _choice_parameter(name: str, default: str, description: str, choices: tuple[str, ...]) -> PatternParameter:
    return PatternParameter(name, "choice", default, description, choices=choices)


_RADIUS_PARAMETER = _size_parameter("radius_mm", "of the ring; six tenths of the way to the border if not given")
_DIGIT_PAIRS = ("2-3", "2-4", "2-5", "3-4", "3-5", "4-5")

_PATTERN_LIST = (
    Pattern(
        "experiment-1",
        "linear motion: three pixels in a row, twice",
        (_DIRECTION_PARAMETER, _CENTRE_PARAMETER),
        experiments.build_linear_motion,
        "300 ms a pixel at 20 ms on, 60 ms off; 500 ms between the two passes.",
    ),
    Pattern(
        "experiment-2",
        "rotational motion: eight pixels around a centre",
        (
            _choice_parameter("direction", "cw", "clockwise or counterclockwise, seen from above", ("cw", "ccw")),
            _choice_parameter(
                "speed", "16", "mm/s as the paper counts it: 200, 100 or 50 ms a pixel", tuple(experiments.SPEEDS_S)
            ),
            _CENTRE_PARAMETER,
        ),
        experiments.build_rotation,
        "25 ms on, 71 ms off, whole pulses only: two a pixel at 16 mm/s, one at 32 and 64. One turn is a choice.",
    ),
    Pattern(
        "experiment-3",
        "localisation: the centre as reference, then one of 3 × 3",
        (
            _integer_parameter("target", 5, "place in the grid, counted by rows from the top left", 1, 9),
            _CENTRE_PARAMETER,
        ),
        experiments.build_localisation,
        "500 ms each at 25 ms on, 25 ms off; 750 ms between. The numbering is a choice.",
    ),
    Pattern(
        "experiment-4",
        "intensity: one pixel for a second, at one of nine powers",
        (_integer_parameter("level", 5, "0.5 W to 2.5 W in steps of 0.25 W", 1, 9), _CENTRE_PARAMETER),
        experiments.build_intensity,
        "25 ms on, 25 ms off. A level above the laser's maximum plays at it: level 9, 2.5 W, on a laser of 2.45 W.",
    ),
    Pattern(
        "experiment-5",
        "temporal pattern: three stimuli of 400 ms, one of them odd",
        (
            _integer_parameter("oddball", 1, "which of the three is odd", 1, 3),
            _choice_parameter(
                "kind", "fast", "how the odd one is pulsed: slow 35/35 ms, fast 10/10 ms", ("slow", "fast")
            ),
            _time_parameter("pause_s", 0.5, "between stimuli; the paper does not say"),
            _CENTRE_PARAMETER,
        ),
        experiments.build_temporal_pattern,
    ),
    Pattern(
        "experiment-6",
        "multi-point: squares of four pixels under two fingers at once",
        (_choice_parameter("digits", "2-3", "which two fingers, 2 is the index", _DIGIT_PAIRS), _CENTRE_PARAMETER),
        experiments.build_two_fingers,
        "40 pulses of 15 ms, the two fingers in turn, 600 ms and the mirrors' moves. "
        "Where the fingers lie and the order within a square are choices.",
    ),
    Pattern("showcase", "a moving dot, a ring, braille, two pairs of fingers", (), build_showcase),
    Pattern(
        "pixel",
        "one pixel, up and down",
        (
            PatternParameter("pixel", "pixel", None, "which; the middle if not given"),
            _height_parameter(100.0),
            _SECONDS_PARAMETER,
        ),
        shapes.build_single_pixel,
    ),
    Pattern(
        "vibration",
        "one pixel that vibrates at one height, each pulse planned with the heat that is there",
        (
            PatternParameter("pixel", "pixel", None, "which; the middle if not given"),
            _height_parameter(200.0, "height of every peak"),
            PatternParameter(
                "peak_to_peak_um",
                "number",
                None,
                "fall between peaks; that of the shortest pulses, which take least energy, if not given",
                "µm",
                min=0.1,
                max=1000.0,
            ),
            PatternParameter("rate_hz", "number", 25.0, "peaks a second", "Hz", min=0.1, max=200.0),
            PatternParameter("seconds", "number", 1.0, "how long", "s", min=0.01, max=600.0),
        ),
        shapes.build_vibration,
        "What swing a rate and a height allow depends on the pixel; a refusal says which.",
    ),
    Pattern("all", "every pixel", (_height_parameter(50.0), _SECONDS_PARAMETER), shapes.build_all_pixels),
    Pattern("checker", "every other pixel", (_height_parameter(50.0), _SECONDS_PARAMETER), shapes.build_checkerboard),
    Pattern("circle", "a ring", (_RADIUS_PARAMETER, _height_parameter(100.0), _SECONDS_PARAMETER), shapes.build_ring),
    Pattern(
        "square",
        "the outline of a square",
        (
            _size_parameter("side_mm", "length of a side; six tenths of the display if not given"),
            _height_parameter(100.0),
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
            _time_parameter("step_s", 0.1, "time a pitch, or what the beam needs if longer"),
        ),
        shapes.build_moving_edge,
    ),
    Pattern(
        "dot",
        "one pixel that runs round a ring, clockwise",
        (
            _RADIUS_PARAMETER,
            _height_parameter(200.0),
            _time_parameter("step_s", 0.06, "time a pixel, or what the beam needs if longer"),
            _integer_parameter("turns", 1, "times round", 1, 100),
        ),
        shapes.build_moving_dot,
    ),
    Pattern(
        "text",
        "text in braille, uncontracted English",
        (
            PatternParameter("text", "text", None, "what to write", required=True),
            _height_parameter(150.0, "peak height of a dot"),
            PatternParameter("seconds", "number", 2.0, "time a page, at least", "s", min=0.0, max=600.0),
            _integer_parameter("dot_step", 1, "pitches between the dots of a cell", 1, 10),
            _integer_parameter("cell_gap", 1, "empty columns between cells", 0, 20),
            _integer_parameter("line_gap", 1, "empty rows between lines", 0, 20),
        ),
        build_text,
    ),
    Pattern(
        "image",
        "a picture, bright is high",
        (_FILE_PARAMETER, _height_parameter(50.0, "height of white"), _SECONDS_PARAMETER, _INVERT_PARAMETER),
        images.build_image,
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
                "pictures a second; the file's own, or as fast as the beam allows, if not given",
                "Hz",
                min=0.01,
                max=50.0,
            ),
            _INVERT_PARAMETER,
        ),
        images.build_animation,
    ),
)

PATTERNS: dict[str, Pattern] = {pattern.name: pattern for pattern in _PATTERN_LIST}


def find_pattern(name: str) -> Pattern:
    """A pattern by its name; raises InputError (unknown_pattern) with the nearest known one."""
    if name not in PATTERNS:
        expected = f"a known pattern, {suggest_nearest(name[:60], list(PATTERNS))}"
        raise InputError("pattern", name, expected, code="unknown_pattern")
    return PATTERNS[name]


def build_pattern(name: str, given: object, config: Config) -> FrameSequence:
    """A pattern's sequence for a display; `given` maps parameters to values.

    A value may be text, as from a command line; a file is its bytes, or these in base64.

    Raises InputError: unknown_pattern, unknown_parameter, missing_parameter, bad_parameter, unknown_pixel,
    does_not_fit, bad_text, bad_picture, too_many, bad_train.
    """
    pattern, where = find_pattern(name), f"pattern {name}"
    sequence = pattern.build(config, where, **pattern.resolve_arguments(given, config))
    return validate_sequence(sequence, where, config)


def describe_patterns() -> list[dict[str, Any]]:
    """Every pattern with its parameters, as JSON has it."""
    return [
        {
            "name": pattern.name,
            "summary": pattern.summary,
            "notes": pattern.notes,
            "parameters": [asdict(parameter) for parameter in pattern.parameters],
        }
        for pattern in _PATTERN_LIST
    ]
