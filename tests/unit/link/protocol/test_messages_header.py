"""Check that the firmware header is the output of generate.py for messages.toml."""

import runpy
import tomllib
from pathlib import Path

CONTRACT = Path(__file__).parents[4] / "firmware_protocol"
GENERATE = runpy.run_path(str(CONTRACT / "generate.py"))
TABLE = tomllib.loads((CONTRACT / "messages.toml").read_text())


def test_the_header_is_current():
    header = (CONTRACT / "core" / "messages.h").read_text()
    assert header == GENERATE["header"](TABLE), "run python firmware_protocol/generate.py"


def test_a_changed_table_changes_the_header():
    changed = tomllib.loads((CONTRACT / "messages.toml").read_text())
    changed["timing"]["hold_max_us"] += 1
    assert GENERATE["header"](changed) != GENERATE["header"](TABLE)
