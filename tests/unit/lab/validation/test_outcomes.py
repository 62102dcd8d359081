"""Every fact is predicted or excluded with a reason, and predictions agree with independent calculations."""

import csv
from math import exp, pi

import pytest

from optodrive.device.config_file import locate_shipped
from optodrive.lab.validation.outcomes import (
    DERIVED_FROM_FITTED,
    FITTED_ON,
    INPUTS,
    NOT_MODELLED,
    OUTCOMES,
    REMARKS,
)
from optodrive.lab.validation.stimuli import pulse_peak_k, width_to_reach_s
from optodrive.physics.paper_facts import PaperFact, load_paper_facts
from optodrive.physics.parameters import load_parameters

CALIBRATED = load_parameters("calibrated")
LITERAL = load_parameters("paper_s1_literal")
FACTS = load_paper_facts()


def test_every_fact_is_spoken_to_or_passed_over_once():
    named = [*INPUTS, *OUTCOMES, *NOT_MODELLED]
    assert sorted(named) == sorted(FACTS)
    assert all(len(reason) > 10 for reason in NOT_MODELLED.values())


def test_fitted_and_remarked_facts_are_outcomes():
    assert set(FITTED_ON) == {"kappa", "tau_g", "phi"}
    assert {*FITTED_ON.values(), *DERIVED_FROM_FITTED, *REMARKS} <= set(OUTCOMES)


@pytest.mark.parametrize("fact", FITTED_ON.values())
def test_fitted_facts_are_met(fact):
    assert OUTCOMES[fact](CALIBRATED) == pytest.approx(FACTS[fact].value, rel=1e-3)


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("parameters", [CALIBRATED, LITERAL], ids=["calibrated", "literal"])
def test_inputs_are_the_papers_own(name, parameters):
    assert INPUTS[name](parameters) == pytest.approx(FACTS[name].value, rel=0.021)


def test_every_miss_has_its_word_and_no_word_is_left_without_a_miss():
    missed = {name for name, model in OUTCOMES.items() if FACTS[name].is_contradicted(model(CALIBRATED), 0.15)}
    assert missed == set(REMARKS)


def test_absorber_rise_by_hand():
    rise = 0.66 * 2.45 * 382 * (1 - exp(-50e-3 / (382 * 81e-6)))
    assert OUTCOMES["dT_peak_w020"](CALIBRATED) == pytest.approx(rise, rel=1e-12)
    assert OUTCOMES["T_peak_w020"](CALIBRATED) == pytest.approx(rise + 20, rel=1e-12)


def test_efficiencies_multiply():
    stroke, heat, work = (OUTCOMES[name](CALIBRATED) for name in ("eta_stroke", "eta_qt", "eta_tm"))
    assert stroke == pytest.approx(heat * work, rel=1e-12)
    half_work = 0.5 * OUTCOMES["F_peak_w020"](CALIBRATED) * OUTCOMES["z_peak_w020"](CALIBRATED)
    assert stroke == pytest.approx(half_work / (0.66 * 2.45 * 0.05), rel=1e-12)


def test_heat_in_the_gas():
    assert OUTCOMES["dQ_air"](CALIBRATED) == pytest.approx(10e-6 * OUTCOMES["dT_air_isometric"](CALIBRATED))


def test_the_literal_set_lags():
    for name, max_ratio in {"z_peak_w020": 0.5, "z_tp8_w040": 0.3, "dpp_200Hz": 0.05}.items():
        assert 0 < OUTCOMES[name](LITERAL) / FACTS[name].value < max_ratio


def test_repeats_agree_and_force_is_linear():
    assert OUTCOMES["z_repeat_w040"](CALIBRATED) < 1e-12
    assert OUTCOMES["F_linear_in_P"](CALIBRATED) == pytest.approx(1.0, rel=1e-12)


def said(name):
    return OUTCOMES[name](CALIBRATED)


def test_figures_in_the_remarks_are_so():
    added = 0.5 * pi * FACTS["cavity_r"].value ** 2 * FACTS["z_peak_w020"].value
    values = {
        "F_peak_w055": (FACTS["F_peak_w055"].value / FACTS["F_peak_w020"].value, "0.56", ".2f"),
        "dT_air_isometric": (100 * added / FACTS["V_pixel"].value, "44 %", ".0f"),
        "dQ_air": (1e6 * FACTS["dQ_air"].value / FACTS["dT_air_isometric"].value, "8.8 µJ/K", ".1f"),
        "N_50um": (1e3 / FACTS["N_50um"].value, "4.6 ms", ".1f"),
        "N_400um": (1e3 / FACTS["N_400um"].value, "37.7 ms", ".1f"),
    }
    for name, (value, text, digits) in values.items():
        assert text in REMARKS[name]
        assert text.startswith(format(value, digits)), name
    assert 293 * added / FACTS["V_pixel"].value > 100
    assert format(said("F_peak_w055") / said("F_peak_w020"), ".2f") == "0.47"
    assert format(said("N_400um") / FACTS["N_400um"].value, ".2f") == "1.24"


def test_heights_at_the_papers_display_rates():
    kappa, pixel = CALIBRATED.kappa.value, CALIBRATED.build_pixel(0.55e-3)
    heights = {name: kappa * pulse_peak_k(pixel, 2.45, 1 / FACTS[name].value) for name in ("N_50um", "N_400um")}
    assert heights["N_50um"] / 50e-6 == pytest.approx(2.0, abs=0.05)
    assert heights["N_400um"] / 400e-6 == pytest.approx(1.07, abs=0.005)
    slowest = max(width_to_reach_s(CALIBRATED.build_pixel(row.width_m), 2.45, 50e-6) for row in CALIBRATED.bridge)
    assert format(1 / slowest, ".0f") == "374"
    assert "374/s" in REMARKS["N_50um"]


def fact(value, unit="m", relation="="):
    return PaperFact("x", "", relation, value, unit, None, "", "")


def test_ratios_of_values_temperatures_and_bounds():
    assert fact(2.0).ratio(3.0) == 1.5
    assert fact(120.0, "°C").ratio(70.0) == 0.5
    assert fact(2.0, relation="<").ratio(1.0) is None


@pytest.mark.parametrize(
    ("relation", "model", "missed"),
    [("=", 1.14, False), ("=", 1.16, True), ("=", 0.84, True), ("<", 0.1, False), ("<", 1.01, True)],
)
def test_what_counts_as_a_miss(relation, model, missed):
    assert fact(1.0, relation=relation).is_contradicted(model, 0.15) is missed


def test_the_file_has_one_row_a_fact():
    with locate_shipped("paper_facts.csv").open(encoding="utf-8", newline="") as file:
        ids = [row["id"] for row in csv.DictReader(file)]
    assert len(ids) == len(set(ids)) == len(FACTS)
