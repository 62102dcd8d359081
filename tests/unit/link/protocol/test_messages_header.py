"""The generated files: generate.py makes header, model, states and the page's table from messages.toml."""

import runpy
import tomllib
from pathlib import Path

import pytest

CONTRACT = Path(__file__).parents[4] / "firmware_protocol"
GENERATE = runpy.run_path(str(CONTRACT / "generate.py"))
TABLE = tomllib.loads((CONTRACT / "messages.toml").read_text())
GENERATED = {
    "build_header": CONTRACT / "core" / "messages.h",
    "build_model_table": CONTRACT / "model" / "transitions.pml",
    "build_page_module": GENERATE["PAGE"] / "board_states.js",
    "build_states_module": GENERATE["STATES_MODULE"],
}


@pytest.mark.parametrize("build", GENERATED)
def test_a_generated_file_is_current(build):
    assert GENERATED[build].read_text() == GENERATE[build](TABLE), "run python firmware_protocol/generate.py"


def test_the_page_is_current():
    page = (CONTRACT / "PROTOCOL.md").read_text()
    assert page == GENERATE["build_protocol_page"](TABLE, page), "run python firmware_protocol/generate.py"


def test_entries_of_one_event_that_differ_are_refused():
    changed = tomllib.loads((CONTRACT / "messages.toml").read_text())
    entry = next(item for item in changed["transition"] if item["event"] == "disarm")
    entry["drops"] = False
    with pytest.raises(ValueError, match="disarm in ARMING: two entries differ"):
        GENERATE["build_header"](changed)
