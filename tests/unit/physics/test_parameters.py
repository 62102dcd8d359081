"""Parameter files: loading, and every refusal."""

from math import pi

import pytest

from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config, locate_shipped
from optodrive.physics.parameters import build_display_pixels, load_parameters

SETS = ["calibrated", "paper_s1_literal"]


@pytest.fixture
def text():
    return locate_shipped("parameters", "calibrated.toml").read_text(encoding="utf-8")


def load_text(tmp_path, text):
    path = tmp_path / "own.toml"
    path.write_text(text, encoding="utf-8")
    return load_parameters(path)


@pytest.mark.parametrize("name", SETS)
def test_shipped_sets_say_who_they_are(name):
    parameters = load_parameters(name)
    assert parameters.name == name
    assert len(parameters.claims) > 100


def test_literal_values_follow_from_text_s1():
    literal = load_parameters("paper_s1_literal")
    gas_pa_per_k = 101_325 / 300
    compliance = 3 / 1280 * (1 - 0.49**2) * 1.5e-3**4 / (50e3 * 0.25e-3**3)
    assert literal.tau_g.value == pytest.approx(1e-3 / (0.026 * 2e-3 * 1.5e-3) * 10e-6 / 2, rel=1e-3)
    assert literal.kappa.value == pytest.approx(compliance * gas_pa_per_k, rel=1e-3)
    assert literal.phi.value == pytest.approx(pi * 1.5e-3**2 * gas_pa_per_k, rel=1e-3)


def test_sets_share_what_is_the_papers_own():
    literal, calibrated = map(load_parameters, reversed(SETS))
    for name in ("epsilon", "R_width_product", "C_mean", "bridge"):
        assert getattr(literal, name) == getattr(calibrated, name)


def test_fitted_values_carry_a_sigma():
    calibrated = load_parameters("calibrated")
    for parameter in (calibrated.kappa, calibrated.tau_g, calibrated.phi):
        assert parameter.sigma is not None
        assert 0 < parameter.sigma < parameter.value


def test_a_width_in_the_table_has_its_row_and_another_the_law():
    calibrated = load_parameters("calibrated")
    row, between = calibrated.build_pixel(0.40e-3), calibrated.build_pixel(0.30e-3)
    assert (row.r_k_per_w, row.c_j_per_k) == (184.0, 126e-6)
    assert between.r_k_per_w == pytest.approx(73.3 / 0.30)
    assert between.c_j_per_k == 101e-6


def test_a_displays_pixels():
    assert len(build_display_pixels(load_config("display-437"), load_parameters("calibrated"))) == 437


def test_an_own_file_reads_like_a_shipped_one(tmp_path, text):
    assert load_text(tmp_path, text) == load_parameters("calibrated")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('unit = "s"', 'unit = "ms"', "tau_g in s, not in 'ms'"),
        ('value = 382.0, unit = "K/W"', 'value = 382.0, unit = "W/K"', "bridge.0: got 'inconsistent values'"),
        ("value = 0.66", "value = -0.66", "epsilon.value: got -0.66, expected greater than or equal to 0"),
        ("value = 0.66", "value = nan", "epsilon.value: got nan"),
        ("sigma = 0.007", "sigma = -1", "epsilon.sigma: got -1"),
        ("[phi]", "[psi]", "psi"),
        ('format = "optodrive-parameters"', 'format = "optodrive-config"', "format: got 'optodrive-config'"),
        ("version = 1", "version = 2", "version: got 2"),
        ("[epsilon]", "[epsilon", "expected valid TOML"),
    ],
)
def test_wrong_files_are_refused_in_one_line(tmp_path, text, old, new, message):
    assert old in text
    with pytest.raises(InputError) as refusal:
        load_text(tmp_path, text.replace(old, new, 1))
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_missing_value_is_named(tmp_path, text):
    with pytest.raises(InputError, match=r"tau_g: missing"):
        load_text(tmp_path, text[: text.index("[tau_g]")] + text[text.index("[kappa]") :])


def test_unknown_names_and_missing_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="calibrated, extended, paper_s1_literal, surroundings"):
        load_parameters("best")
    with pytest.raises(InputError, match="readable file"):
        load_parameters(tmp_path / "none.toml")


TERM = """
[terms.{term}.{name}]
value = {value}
unit = "{unit}"
source = "here"
"""
WRONG_TERMS = {
    "unknown term": (("wall_heeting", "resistance", 20.0, "K/W"), "a known term, nearest is 'wall_heating'"),
    "unknown parameter": (("bridge_conductivity", "exponant", 0.1, "1"), "nearest is 'exponent'"),
    "wrong unit": (("bridge_conductivity", "exponent", 0.1, "K"), "exponent.unit: got 'K', expected '1'"),
    "out of range": (("bridge_conductivity", "exponent", 3.0, "1"), "expected 0 to 1.3 1"),
    "missing parameter": (("wall_heating", "resistance", 20.0, "K/W"), "capacity: missing"),
    "negative": (("bridge_conductivity", "exponent", -0.1, "1"), "exponent.value: got -0.1, expected 0 to 1.3"),
}


def test_a_parameter_without_its_table_is_refused_with_the_form_of_one(tmp_path):
    path = tmp_path / "mine.toml"
    head = 'format = "optodrive-parameters"\nversion = 1\nname = "mine"\nbase = "calibrated"\nclaims = "none"\n'
    path.write_text(head + "terms.gas_leak.rate = 4.0\n")
    with pytest.raises(InputError, match=r"gas_leak.rate: got 4.0, expected a table with keys, as in { value = … }"):
        load_parameters(path)


@pytest.mark.parametrize("case", WRONG_TERMS)
def test_wrong_terms_are_refused_in_one_line(case, tmp_path):
    (term, name, value, unit), message = WRONG_TERMS[case]
    path = tmp_path / "mine.toml"
    head = 'format = "optodrive-parameters"\nversion = 1\nname = "mine"\nbase = "calibrated"\nclaims = "none"\n'
    path.write_text(head + TERM.format(term=term, name=name, value=value, unit=unit))
    with pytest.raises(InputError, match=message) as caught:
        load_parameters(path)
    assert "\n" not in str(caught.value)


def test_a_base_must_be_a_shipped_set(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('format = "optodrive-parameters"\nversion = 1\nbase = "best"\n')
    with pytest.raises(InputError, match="base: got 'best', expected the name of a shipped parameter set"):
        load_parameters(path)
