"""`optodrive validate --diagnose`: hidden faults are named, the paper's facts tell their story, nothing leaks."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from optodrive.cli.main import run
from optodrive.lab.validation.candidate_causes import catalogue
from optodrive.lab.validation.cause_search import Search
from optodrive.lab.validation.contradictions import contradictions
from optodrive.lab.validation.corrected_model import LONGEST_S, Extended
from optodrive.lab.validation.extended_outcomes import outcomes
from optodrive.lab.validation.measured_facts import GROUPS, HEIGHTS_M, LEFT_OUT, MEASURED, recording
from optodrive.lab.validation.narrative import after_table, answer, before_table, rows
from optodrive.lab.validation.paper_outcomes import FULL_W, OUTCOMES
from optodrive.lab.validation.stimulus_response import width_to_reach_s
from optodrive.lab.validation.study import factor, left_out, study
from optodrive.physics.paper_facts import AMBIENT_C, paper_facts
from optodrive.physics.parameters import Parameter, load_parameters

LITERAL = load_parameters("paper_s1_literal")
ALIKE = {"force_area", "load_cell_gives"}
SLOW = {"dpp_law", "slow_law"}


@pytest.fixture(scope="module")
def found():
    return study(paper_facts(), LITERAL)


def changed(**factors):
    """The literal set with some parameters multiplied, by the closed forms of the physics."""
    scaled = {}
    for name, times in factors.items():
        own = getattr(LITERAL, name)
        scaled[name] = Parameter(value=own.value * times, unit=own.unit, source="hidden")
    return LITERAL.model_copy(update=scaled)


def facts_of(parameters, seed):
    """Facts that a set would have made, each with its error; of rates, the error is that of the height."""
    rng = np.random.default_rng(seed)
    facts = dict(paper_facts())
    for datum in recording(facts, LITERAL):
        noise = float(np.exp(datum.sigma * rng.standard_normal()))
        fact = facts[datum.id]
        if datum.id in HEIGHTS_M:
            made = rate(parameters, HEIGHTS_M[datum.id] * noise)
        else:
            zero = AMBIENT_C if fact.unit == "°C" else 0.0
            made = zero + (OUTCOMES[datum.id](parameters) - zero) * noise
        uncertainty = None if fact.uncertainty is None else fact.uncertainty / fact.value * made
        facts[datum.id] = replace(fact, value=made, uncertainty=uncertainty)
    return facts


def rate(parameters, height_m):
    """Of a height out of reach, the rate that the longest pulse gives."""
    return 1.0 / min(width_to_reach_s(parameters.pixel(0.55e-3), FULL_W, height_m), LONGEST_S)


def named(facts):
    return set(Search(LITERAL, recording(facts, LITERAL)).choose().keys)


@pytest.mark.parametrize("seed", range(6))
def test_nothing_hidden_names_nothing(seed):
    assert named(facts_of(LITERAL, seed)) == set()


@pytest.mark.parametrize("seed", range(6))
def test_a_hidden_lag_is_named_alone(seed):
    tau_g_s = float(np.exp(np.random.default_rng(100 + seed).uniform(np.log(1.5e-3), np.log(20e-3))))
    facts = facts_of(changed(tau_g=tau_g_s / LITERAL.tau_g.value), seed)
    assert named(facts) == {"gas_lag"}


@pytest.mark.parametrize("seed", range(6))
def test_a_hidden_force_fault_is_named_alone(seed):
    share = float(np.random.default_rng(200 + seed).uniform(0.05, 0.5))
    told = named(facts_of(changed(phi=share), seed))
    assert len(told) == 1
    assert told <= ALIKE


@pytest.mark.parametrize("seed", range(6))
def test_two_hidden_faults_are_both_named(seed):
    rng = np.random.default_rng(300 + seed)
    facts = facts_of(changed(tau_g=float(rng.uniform(0.03, 0.3)), phi=float(rng.uniform(0.05, 0.4))), seed)
    told = named(facts)
    assert "gas_lag" in told
    assert len(told & ALIKE) == 1
    assert len(told) == 2


def test_every_outcome_is_data_or_has_a_reason_not_to_be():
    assert set(MEASURED) | set(LEFT_OUT) == set(OUTCOMES)
    assert not set(MEASURED) & set(LEFT_OUT)


def test_the_model_is_that_of_the_physics():
    facts = paper_facts()
    calibrated = load_parameters("calibrated")
    for parameters in (LITERAL, calibrated):
        ours = Extended(parameters, {})
        for name in MEASURED:
            theirs = OUTCOMES[name](parameters) - (AMBIENT_C if facts[name].unit == "°C" else 0.0)
            assert ours.outcome(name) == pytest.approx(theirs, rel=2e-3), name


def test_with_terms_it_is_the_simulated_model():
    extended = load_parameters("extended")
    theirs, facts = outcomes(extended), paper_facts()
    values = {key: {name: item.value for name, item in own.items()} for key, own in extended.terms.items()}
    numbers = {
        "bridge_conductivity": values["bridge_conductivity"]["exponent"],
        "gas_membrane": values["gas_membrane"]["share"],
        "wall_heating": values["wall_heating"]["resistance"],
        "gas_lag": extended.tau_g.value,
    }
    ours = Extended(LITERAL, numbers)
    for name in set(MEASURED) - {"F_peak_w020", "F_peak_w055"}:
        expected = theirs[name] - (AMBIENT_C if facts[name].unit == "°C" else 0.0)
        assert ours.outcome(name) == pytest.approx(expected, rel=0.02), name


def test_the_papers_facts_name_lag_force_and_dead_time(found):
    keys = {item.key for item in found.named}
    assert "gas_lag" in keys
    assert keys & ALIKE
    force = next(item for item in found.named if item.key in ALIKE)
    assert {force.key, *force.alike} == ALIKE
    assert set(force.rests_on) == set(GROUPS["forces"])
    dead = next(item for item in found.named if item.key == "dead_time")
    assert dead.rests_on == ("N_50um",)
    assert found.unexplained == ()
    assert found.chosen.chi2 < len(found.data)
    assert not found.chosen.at_limit


def test_the_facts_refuse_plate_and_constant_volume_by_themselves(found):
    assert {item.key for item in found.contradicted} == {"constant_volume", "small_deflection"}
    verdicts = {item.key: item.verdict for item in found.candidates}
    assert verdicts["gas_membrane"] == "as good"
    assert verdicts["membrane_plate"] == "ruled out"
    text = "\n".join(before_table(found))
    assert "right by chance" in text
    assert "constant volume" in text


def test_a_membrane_that_hardly_rises_contradicts_nothing():
    facts = dict(paper_facts())
    facts["z_peak_w020"] = replace(facts["z_peak_w020"], value=30e-6)
    assert contradictions(facts) == ()


def test_a_rate_without_its_contradiction_needs_no_dead_time():
    facts = dict(paper_facts())
    facts["N_50um"] = replace(facts["N_50um"], value=432.0)
    assert "dead_time" not in named(facts)


def test_the_gain_is_large_where_something_else_shows_the_cause(found):
    groups = {item.label: item for item in found.groups}
    assert set(groups) == set(GROUPS)
    for label in ("displacements", "vibration"):
        assert not groups[label].lost
        assert factor(groups[label].after) < 0.5 * factor(groups[label].before)
    # Nothing but forces shows the force's fault: a warmer gas then pushes harder still, and the answer says so.
    assert set(groups["forces"].lost) & ALIKE
    assert factor(groups["forces"].after) > factor(groups["forces"].before)
    assert "Only forces show" in "\n".join(after_table(found))
    assert {item.label for item in found.singles} == {*GROUPS["forces"], *GROUPS["rates"]}
    assert sorted(name for item in found.predictions for name in item.facts) == sorted(MEASURED)


@pytest.mark.parametrize(("group", "name"), [("displacements", "z_tp8_w040"), ("vibration", "dpp_200Hz")])
def test_what_is_left_out_does_not_leak(found, group, name):
    facts = dict(paper_facts())
    wrong = facts[name]
    facts[name] = replace(wrong, value=7.0 * wrong.value)
    again = left_out(LITERAL, recording(facts, LITERAL), group, GROUPS[group], found.named)
    first = next(item for item in found.groups if item.label == group)
    assert again.causes == first.causes
    for fact, before, after in zip(first.facts, first.after, again.after, strict=True):
        assert after * (7.0 if fact == name else 1.0) == pytest.approx(before, rel=1e-12)


def test_ranges_map_both_ways_and_exclusions_are_known():
    for cause in catalogue().values():
        assert all(other in catalogue() for other in cause.without)
        assert cause.low < cause.high
        assert cause.share(cause.value(0.3)) == pytest.approx(0.3)


def test_the_answer_as_json(found):
    document = json.loads(json.dumps(answer(found), allow_nan=False))
    assert set(document) == {
        "nominal",
        "facts",
        "not_data",
        "chi2",
        "factor",
        "named_from_aicc",
        "alike_within_aicc",
        "causes",
        "candidates",
        "contradictions",
        "unexplained",
        "gain",
    }
    assert [item["id"] for item in document["facts"]] == list(MEASURED)
    told = {item["cause"] for item in document["causes"]} | {item["cause"] for item in document["candidates"]}
    assert told == set(catalogue())
    for item in document["causes"]:
        assert item["ci95"][0] < item["value"] < item["ci95"][1]
    assert {item["left_out"] for item in document["gain"]["groups"]} == set(GROUPS)
    assert document["gain"]["factor_each"]["after"] < document["gain"]["factor_each"]["before"]


def test_the_command_tells_the_story(found, capsys):
    assert run(["validate", "--diagnose"]) == 0
    told = capsys.readouterr().out
    flat = " ".join(told.split())
    for line in before_table(found):
        assert " ".join(line.split()) in flat
    for row in rows(found):
        assert row[0] in told


def test_the_command_prints_one_json_object(found, capsys):
    assert run(["validate", "--diagnose", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["chi2"] == pytest.approx(answer(found)["chi2"])


def test_it_needs_no_extra():
    check = "import sys; sys.modules['scipy'] = None; import optodrive.lab.validation.narrative"
    subprocess.run([sys.executable, "-c", check], check=True, timeout=60)
