import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.planning.stimuli import json_values
from optodrive.planning.stimuli.frame_json import parse_live_frame
from optodrive.planning.stimuli.json_values import decode_json
from optodrive.planning.stimuli.sequence_file import parse_sequence

CONFIG = DISPLAYS["display-16"].config
PARSERS = {
    "a pattern's parameters": lambda text: decode_json(text, "body"),
    "a sequence": lambda text: parse_sequence(text.encode(), CONFIG, "body"),
    "a streamed frame": lambda text: parse_live_frame(text, 0, 16),
}
BODIES = {
    "the last key repeats the first": lambda count: [*range(count), 0],
    "the last key is there twice": lambda count: [*range(count), count - 1],
    "one key": lambda count: [0] * count,
}


class CountingKey(str):
    """Key that counts how often it is hashed or compared."""

    count = 0

    def __hash__(self):
        CountingKey.count += 1
        return super().__hash__()

    def __eq__(self, other):
        CountingKey.count += 1
        return super().__eq__(other)


@pytest.mark.parametrize("parser", PARSERS)
@pytest.mark.parametrize("body", BODIES)
def test_a_repeated_key_is_refused_in_linear_time(parser, body, monkeypatch):
    find, searched = json_values._find_repeated_key, []

    def count_work(pairs):
        CountingKey.count = 0
        found = find([(CountingKey(key), value) for key, value in pairs])
        searched.append((len(pairs), CountingKey.count))
        return found

    monkeypatch.setattr(json_values, "_find_repeated_key", count_work)
    text = "{" + ",".join(f'"{key:06d}":1' for key in BODIES[body](5_000)) + "}"
    with pytest.raises(InputError, match="each key of an object once"):
        PARSERS[parser](text)
    ((keys, work),) = searched
    assert keys >= 5_000
    assert work <= 4 * keys


def test_the_first_repeated_key_is_named():
    with pytest.raises(InputError, match="'b'"):
        decode_json('{"a": 1, "b": {"a": 1}, "c": 2, "b": 3, "a": 4}', "body")
