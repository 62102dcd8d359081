import time

import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.planning.stimuli.sequence_file import parse_json, parse_sequence
from optodrive.planning.stimuli.streamed_frame import parse_live_frame

CONFIG = DISPLAYS["display-16"].config
PARSERS = {
    "a pattern's parameters": lambda text: parse_json(text, "body"),
    "a sequence": lambda text: parse_sequence(text.encode(), CONFIG, "body"),
    "a streamed frame": lambda text: parse_live_frame(text, 0, 16),
}
BODIES = {
    "the last key repeats the first": lambda count: [*range(count), 0],
    "the last key is there twice": lambda count: [*range(count), count - 1],
    "one key": lambda count: [0] * count,
}


def measure_s(parse, keys):
    """Return the shortest of three times for which the processor parses an object that repeats a key."""
    text = "{" + ",".join(f'"{key:06d}":1' for key in keys) + "}"
    times = []
    for _ in range(3):
        begin_s = time.process_time()
        with pytest.raises(InputError, match="each key of an object once"):
            parse(text)
        times.append(time.process_time() - begin_s)
    return min(times)


@pytest.mark.parametrize("parser", PARSERS)
@pytest.mark.parametrize("body", BODIES)
def test_a_repeated_key_is_refused_in_linear_time(parser, body):
    parse, keys = PARSERS[parser], BODIES[body]
    measure_s(parse, keys(100))
    # 600 kB against 75 kB: eight times as long if the time is linear, 64 times if it is quadratic.
    assert measure_s(parse, keys(60_000)) < 30 * measure_s(parse, keys(7_500))


def test_the_first_repeated_key_is_named():
    with pytest.raises(InputError, match="'b'"):
        parse_json('{"a": 1, "b": {"a": 1}, "c": 2, "b": 3, "a": 4}', "body")
