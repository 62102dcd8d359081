"""`optodrive config show` prints the effective configuration as a file would state it."""

import json
import tomllib

import pytest

from optodrive.cli.main import run
from optodrive.device.config_file import list_shipped_configs


def drop_unset(table):
    """Return a table without the keys that have no value, which TOML cannot state."""
    return {
        key: drop_unset(value) if isinstance(value, dict) else value
        for key, value in table.items()
        if value is not None
    }


@pytest.mark.parametrize("name", list_shipped_configs())
def test_it_states_all_that_the_json_states_in_short_lines(name, capsys):
    assert run(["config", "show", "--config", name]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(len(line) for line in lines if not line.startswith("missing")) < 120
    assert run(["config", "show", "--config", name, "--json"]) == 0
    document = drop_unset(json.loads(capsys.readouterr().out))
    document["display"]["pixels"] = f"{len(document['display']['pixels'])}, listed with --json"
    assert tomllib.loads("\n".join(line for line in lines if not line.endswith(" = null"))) == document
