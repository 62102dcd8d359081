"""`optodrive validate`, run as a process, and the rows of its table."""

import json
import subprocess
import sys

import pytest

from optodrive.cli import main
from optodrive.cli.validation_table import build_validation_rows, format_cells
from optodrive.lab.validation.outcomes import EXTENDED_FITTED_ON, FITTED_ON, INPUTS, NOT_MODELLED, OUTCOMES


@pytest.fixture(scope="module")
def rows():
    return {row.fact.id: row for row in build_validation_rows()}


def run(*options):
    command = [sys.executable, "-c", "from optodrive.cli.main import main; main()", "validate", *options]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_rows_are_all_that_can_be_said(rows):
    assert set(rows) == {*INPUTS, *OUTCOMES}
    assert {name for name, row in rows.items() if row.role == "fitted"} == {*FITTED_ON.values(), "eta_stroke"}
    assert {name for name, row in rows.items() if row.role == "input"} == set(INPUTS)


def test_cells_are_in_readable_units(rows):
    assert format_cells(rows["z_tp8_w040"])[:2] == ["z_tp8_w040", "155.2 ± 2.3 µm"]
    assert format_cells(rows["z_repeat_w040"])[1] == "< 0.5 µm"
    assert format_cells(rows["z_repeat_w040"])[3] == ""
    assert format_cells(rows["R_w020"]) == [
        "R_w020",
        "382 K/W",
        "382",
        "1.00",
        "382",
        "1.00",
        "input",
        "382",
        "1.00",
        "input",
    ]


def test_the_table_shows_every_fact_whole_also_without_a_terminal(rows):
    text = run()
    for row in rows.values():
        line = next(line for line in text.splitlines() if f" {row.fact.id} " in line)
        assert all(cell in line for cell in format_cells(row))
        if row.remark:
            assert f"  {row.fact.id}: {row.remark}" in text
    assert "…" not in text


def test_json_is_one_object_in_si_units(rows, capsys):
    assert main.run(["validate", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    facts = {item["id"]: item for item in document["facts"]}
    assert list(facts) == list(rows)
    assert facts["z_tp8_w040"]["value"] == pytest.approx(155.2e-6)
    assert facts["z_tp8_w040"]["uncertainty"] == pytest.approx(2.3e-6)
    assert facts["N_50um"]["calibrated_ratio"] == pytest.approx(rows["N_50um"].calibrated_ratio)
    assert facts["z_repeat_w040"]["calibrated_ratio"] is None
    assert document["not_modelled"] == NOT_MODELLED
    assert document["fitted_on"] == FITTED_ON
    assert document["extended_fitted_on"] == EXTENDED_FITTED_ON
    for name in EXTENDED_FITTED_ON.values():
        assert facts[name]["extended_ratio"] == pytest.approx(1.0, abs=0.005)
        assert facts[name]["extended_role"] == "fitted"


@pytest.mark.slow
def test_it_loads_nothing_heavy():
    check = (
        "import sys; import optodrive.cli.validation_table as v; v.print_validation(True);"
        " assert 'scipy.optimize' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", check], check=True, capture_output=True)


def test_a_model_of_ones_own_stands_beside_the_others(tmp_path):
    path = tmp_path / "model.toml"
    path.write_text(
        'format = "optodrive-parameters"\nversion = 1\nname = "mine"\nbase = "calibrated"\nclaims = "none"\n'
        'planner_terms = ["laser_turn_on"]\n'
        '[terms.laser_turn_on.time]\nvalue = 2e-3\nunit = "s"\nsource = "here"\n'
    )
    rows = {row.fact.id: row for row in build_validation_rows(path)}
    assert rows["R_w020"].model == rows["R_w020"].calibrated
    # The light rises 2 ms late: a 50 ms pulse is hardly affected; a pulse to 50 µm takes about 2 ms longer.
    assert rows["z_peak_w020"].model == pytest.approx(rows["z_peak_w020"].calibrated, rel=0.03)
    width_s = 1.0 / rows["N_50um"].model - 1.0 / rows["N_50um"].calibrated
    assert width_s == pytest.approx(1.6e-3, abs=0.4e-3)
    assert format_cells(rows["R_w020"])[-2:] == ["382", "1.00"]
    assert rows["z_repeat_w040"].model_ratio is None
