"""Configurations of all older versions: migrated, they plan as before, or the lines to change are listed.

old_configs/ holds display-437 in every form that it had under versions 1 to 3.
"""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.cli.main import run
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config import Config
from optodrive.device.config_file import RENAMED_KEYS, load_config, locate_shipped
from optodrive.device.config_migration import migrate_config
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence

FOLDER = Path(__file__).parent / "old_configs"
BY_RENAMING = ("version-3-first", "version-3-gap")
BY_HAND = ("version-1-first", "version-1-gap", "version-2")
SHIPPED = tomllib.loads(locate_shipped("display-437.toml").read_text())


def plan(config):
    display = DisplayModel.from_config(config)
    target_m = np.linspace(0.0, 120e-6, len(display.layout))
    frames = FrameSequence((TactileFrame("a", 0.0, 0.5, target_m),))
    return plan_sequence(display, frames, *display.build_cold_state()).plan


def test_every_old_configuration_is_tried():
    assert sorted(path.stem for path in FOLDER.iterdir()) == sorted((*BY_RENAMING, *BY_HAND))


@pytest.mark.parametrize("name", BY_RENAMING)
def test_a_configuration_whose_keys_were_renamed_plans_as_before(name, tmp_path, capsys):
    old, new = FOLDER / f"{name}.toml", tmp_path / "new.toml"
    before = old.read_text()
    assert run(["config", "migrate", str(old), "--out", str(new)]) == 0, capsys.readouterr().err
    migrated, today = load_config(new), DISPLAYS["display-437"].config
    # The touch cap and the declared uncertainties are other numbers today, under the same keys.
    kept = {"touch_max_c": migrated.limits.touch_max_c, "uncertainty": migrated.limits.uncertainty}
    assert migrated == today.model_copy(update={"limits": today.limits.model_copy(update=kept)}).read_from(new)
    planned, expected = plan(migrated), plan(today.model_copy(update={"limits": migrated.limits}))
    assert len(planned) > 400
    np.testing.assert_equal(vars(planned), vars(expected))
    comments = [line.partition("#")[2] for line in before.splitlines()]
    assert [line.partition("#")[2] for line in new.read_text().splitlines()] == comments
    assert old.read_text() == before


@pytest.mark.parametrize("name", BY_HAND)
def test_the_lines_to_change_suffice(name, capsys):
    old = FOLDER / f"{name}.toml"
    assert run(["config", "migrate", str(old), "--json"]) == 2
    written = capsys.readouterr()
    changes = json.loads(written.out)["by_hand"]
    assert written.err.endswith(f"expected {len(changes)} lines changed by hand, as listed\n")
    table = tomllib.loads(old.read_text())
    for change in changes:
        if change == "version = 4":
            table["version"] = 4
        elif change.startswith("rename "):
            (place, _, new), (section, key) = change[7:].split(), change[7:].split()[0].split(".")
            assert RENAMED_KEYS[place] == new
            table[section][new] = table[section].pop(key)
        else:
            section, verb, key = change.partition(":")[0].split()
            section = section.strip("[]")
            if verb == "remove":
                del table[section][key]
            else:
                table[section][key] = SHIPPED[section][key]
    Config.model_validate(table)


def test_what_is_new_is_only_checked(capsys):
    path = locate_shipped("display-16.toml")
    assert run(["config", "migrate", str(path)]) == 0
    assert capsys.readouterr().out == path.read_text()


def test_a_key_that_no_line_shows_is_left_to_the_reader(tmp_path):
    """In quotes, for example: the text would not change as the table does."""
    text = (FOLDER / "version-3-first.toml").read_text()
    path = tmp_path / "old.toml"
    path.write_text(text.replace("\npulse_rest_min_s =", "\n'pulse_rest_min_s' ="))
    assert migrate_config(path).by_hand == ("version = 4", "rename limits.pulse_rest_min_s to pulse_gap_min_s")


@pytest.mark.parametrize(
    ("version", "says"), [("0", "got 0"), ("5", "got 5"), ("true", "got True"), ('"3"', "got '3'")]
)
def test_another_version_is_refused(version, says, tmp_path, capsys):
    path = tmp_path / "own.toml"
    path.write_text(f'format = "optodrive-config"\nversion = {version}\n')
    assert run(["config", "migrate", str(path)]) == 2
    assert f"version: {says}, expected 1 to 4" in capsys.readouterr().err


def test_no_file_is_overwritten(tmp_path, capsys):
    path = tmp_path / "own.toml"
    path.write_text("mine")
    assert run(["config", "migrate", str(FOLDER / "version-3-gap.toml"), "--out", str(path)]) == 2
    assert "expected a new file; this one exists" in capsys.readouterr().err
    assert path.read_text() == "mine"


@pytest.mark.parametrize("version", [1, 2, 3])
def test_a_refusal_names_renamed_keys_and_the_command(version, tmp_path, capsys):
    path = tmp_path / "own.toml"
    path.write_text(f'format = "optodrive-config"\nversion = {version}\n')
    assert run(["config", "check", "--config", str(path)]) == 2
    said = capsys.readouterr().err
    assert "limits.pulse_rest_min_s is now pulse_gap_min_s" in said
    assert "`optodrive config migrate`" in said
