import copy

import jsonschema_rs
import pytest

from displays import DISPLAYS
from optodrive.daemon.api.openapi import BODY_SCHEMAS, SEQUENCE_EXAMPLE
from optodrive.planning.stimuli.pattern_registry import build_pattern
from optodrive.planning.stimuli.sequence_file import parse_sequence, sequence_to_json

SCHEMA = jsonschema_rs.validator_for({**BODY_SCHEMAS["FrameSequence"], "components": {"schemas": BODY_SCHEMAS}})


@pytest.mark.parametrize("name", ["showcase", "experiment-1", "experiment-6", "text", "vibration"])
def test_patterns_match_the_schema_of_sequences(name):
    config = DISPLAYS["display-437"].config
    given = {"text": "hello"} if name == "text" else {}
    SCHEMA.validate(sequence_to_json(build_pattern(name, given, config)))


@pytest.mark.parametrize("name", sorted(DISPLAYS))
def test_the_example_is_valid_on_every_display(name):
    SCHEMA.validate(SEQUENCE_EXAMPLE)
    parse_sequence(copy.deepcopy(SEQUENCE_EXAMPLE), DISPLAYS[name].config, "body")


@pytest.mark.parametrize(
    "wrong",
    [
        {},
        {"frames": []},
        {"frames": [], "trains": []},
        {"frames": SEQUENCE_EXAMPLE["frames"], "train": []},
        {"frames": [{**SEQUENCE_EXAMPLE["frames"][0], "show_at_s": -1.0}]},
        {"frames": [{**SEQUENCE_EXAMPLE["frames"][0], "target_um": {"00": 1}}]},
        {"frames": [{**SEQUENCE_EXAMPLE["frames"][0], "intensity": {"0": 1}}]},
        {"frames": [{**SEQUENCE_EXAMPLE["frames"][1], "intensity": {"0": -1}}]},
        {"frames": [{"show_at_s": 0.0, "duration_s": 0.5}]},
        {"trains": [{**SEQUENCE_EXAMPLE["trains"][0], "period_s": 0.1}]},
        {"trains": [{**SEQUENCE_EXAMPLE["trains"][1], "intensity": 1}]},
        {"trains": [{**SEQUENCE_EXAMPLE["trains"][0], "pixel": 1.5}]},
    ],
)
def test_the_parser_refuses_what_the_schema_refuses(wrong):
    assert not SCHEMA.is_valid(wrong)
    with pytest.raises(Exception, match="body"):
        parse_sequence(wrong, DISPLAYS["display-437"].config, "body")
