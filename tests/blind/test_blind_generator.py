"""The generator and the score of the blind tests work as specified."""

from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from blind_causes import CATALOGUE, CONFUSABLE, MECHANISMS, apply_effects
from blind_display import DISPLACEMENT, FORCE, TEMPERATURE, Physics, compute_nominal_rises, find_edges, simulate_signals
from blind_lab import BLOCKS, MIN_EFFECT_SIGMA, draw_case
from blind_noise import NoiseColour
from blind_score import format_table, score_answer, wilson
from blind_session import (
    build_bench,
    build_scene,
    build_session_runs,
    draw_base,
    draw_design,
    draw_instruments,
    simulate_ideal_rises,
    simulate_ideal_signals,
)

SIGNALS = {TEMPERATURE, DISPLACEMENT, FORCE, "mirror_x_rad", "mirror_y_rad"}


def contents(path):
    """Return the whole content of a file as values."""
    found = {}
    with h5py.File(path) as file:
        found["/"] = dict(file.attrs)

        def visit(name, item):
            found[name] = dict(item.attrs)
            if isinstance(item, h5py.Dataset):
                found[name + "=="] = item[()].tobytes()

        file.visititems(visit)
    return found


@pytest.fixture(scope="module")
def lab():
    """Return a session with several pixels and a mirror, without hidden effects."""
    rng = np.random.default_rng(5)
    base, _ = draw_base(rng)
    instruments = draw_instruments(rng)
    design = draw_design(rng, base, instruments, pixels=True, mirrors=True)
    runs = build_session_runs(rng, design, instruments)
    return SimpleNamespace(base=base, instruments=instruments, runs=runs, bench=build_bench(base, instruments, runs))


def test_nominal_part_agrees_with_scipy():
    p = Physics(R=300.0, C=9e-5, tau_g=2.5e-3)
    pulses = np.array([[0.02, 0.06, 2.0, 0.0], [0.11, 0.004, 1.0, 0.0]])
    t = np.linspace(0.0, 0.25, 900)
    edges, powers = find_edges(pulses, 0)

    def rates(now, s):
        k = np.searchsorted(edges, now, side="right") - 1
        power = powers[k] if k >= 0 else 0.0
        return [(power - s[0] / p.R) / p.C, (0.5 * s[0] - s[1]) / p.tau_g]

    state, theta, gas = np.zeros(2), np.zeros_like(t), np.zeros_like(t)
    for a, b in zip([0.0, *edges], [*edges, 0.3], strict=True):
        inside = (t >= a) & (t < b)
        end = np.nextafter(b, a)
        got = solve_ivp(rates, (a, end), state, t_eval=[*t[inside], end], rtol=1e-9, atol=1e-9, method="DOP853")
        theta[inside], gas[inside] = got.y[0, :-1], got.y[1, :-1]
        state = got.y[:, -1]
    shown = simulate_signals(p, pulses, dict.fromkeys((TEMPERATURE, DISPLACEMENT, FORCE), t), ambient_k=295.0)
    assert np.abs(shown[TEMPERATURE] - 295.0 - theta).max() < 1e-5 * theta.max()
    assert np.abs(shown[DISPLACEMENT] / p.kappa - gas).max() < 1e-5 * gas.max()
    assert np.allclose(shown[FORCE] / p.phi, shown[DISPLACEMENT] / p.kappa)
    closed = compute_nominal_rises(edges, powers, t, p.R, p.C, p.tau_g)
    assert np.abs(closed[0] - theta).max() < 1e-6 * theta.max()
    assert np.abs(closed[1] - gas).max() < 1e-6 * gas.max()


@pytest.mark.parametrize("key", [*CATALOGUE, *MECHANISMS])
def test_each_changes_the_data_and_steps_are_short_enough(lab, key):
    effect = (CATALOGUE | MECHANISMS)[key](np.random.default_rng(1), build_scene(lab.base, lab.runs))
    truth = apply_effects(lab.base, (effect,))
    nothing, shown = simulate_ideal_rises(lab.base, lab.runs, lab.base), simulate_ideal_rises(lab.base, lab.runs, truth)
    spread = {n: lab.instruments.colours[n].white for n in lab.instruments.colours}
    change = max(np.abs(a[n] - b[n]).max() / spread[n] for a, b in zip(shown, nothing, strict=True) for n in a)
    assert change > 0.3
    run = next(r for r in lab.runs if r.experiment.name.startswith("width"))
    coarse, fine = (
        simulate_signals(
            truth, run.experiment.pulses, run.experiment.times, session_s=900.0, noise_seed=3, refinement=f
        )
        for f in (1.0, 4.0)
    )
    for name, y in fine.items():
        assert np.abs(coarse[name] - y).max() < 1e-5 * np.ptp(y)


@pytest.mark.parametrize("kind", ["ou", "oscillation"])
def test_whitening_is_the_inverse_of_the_covariance(kind):
    dt, n = 1e-3, 60
    colour = (
        NoiseColour(0.2, "ou", ((0.3, 0.004), (0.1, 0.05)))
        if kind == "ou"
        else NoiseColour(0.2, "oscillation", ((0.3, 60.0, 0.3),))
    )
    a, _, spread, read = colour.system(dt)
    lags = [read @ np.linalg.matrix_power(a, k) @ spread @ read for k in range(n)]
    covariance = 0.04 * np.eye(n) + np.array([[lags[abs(i - j)] for j in range(n)] for i in range(n)])
    y = np.random.default_rng(0).standard_normal((n, 2))
    white = colour.whiten(y, dt)
    assert np.allclose(white.T @ white, y.T @ np.linalg.solve(covariance, y))
    noise = colour.sample(np.random.default_rng(1), 20000, dt)
    assert np.var(noise) == pytest.approx(covariance[0, 0], rel=0.1)
    assert np.var(colour.whiten(noise[:, None], dt)) == pytest.approx(1.0, rel=0.05)


def test_a_change_of_base_parameters_is_no_effect(lab):
    moved = lab.base.with_(R=lab.base.R * 1.1, C=lab.base.C * 0.95, kappa=lab.base.kappa * 1.05)
    shown = simulate_ideal_rises(lab.base, lab.runs, moved)
    assert lab.bench.sigma(shown, refits=1) < 100.0
    assert lab.bench.sigma(shown) < 0.5


def test_the_noise_that_is_added_is_the_noise_that_is_meant(lab):
    rng = np.random.default_rng(3)
    noisy = []
    for run in lab.runs:
        noisy.append({})
        for name, y in simulate_ideal_signals(lab.base, run, jittered=True).items():
            t = run.experiment.times[name]
            y = y + lab.instruments.run_variation.baseline[name] * rng.standard_normal()
            y = y + lab.instruments.colours[name].sample(rng, len(t), float(t[1] - t[0]))
            if name == TEMPERATURE:
                y = y - run.stated_ambient_k
            elif name.startswith("mirror"):
                y = y - simulate_ideal_signals(lab.base, run, jittered=False)[name]
            noisy[-1][name] = y
    count = sum(len(y) for run in noisy for y in run.values())
    assert lab.bench.sigma(noisy) ** 2 == pytest.approx(count, abs=5.0 * np.sqrt(2.0 * count))


def test_the_same_seed_gives_the_same_file(tmp_path):
    first, again, other = (draw_case("none", seed, tmp_path / str(k)) for k, seed in enumerate((4, 4, 5)))
    assert contents(first.path) == contents(again.path)
    assert contents(first.path) != contents(other.path)
    assert (first.causes, first.effect_sigma) == ((), 0.0)
    named = draw_case("single", 7, tmp_path / "a"), draw_case("single", 7, tmp_path / "b", cause="power_nonlinearity")
    assert contents(named[0].path) == contents(named[1].path)


@pytest.mark.parametrize("seed", [*range(2), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 18))])
def test_singles_show(tmp_path, seed):
    case = draw_case("single", seed, tmp_path)
    assert case.causes == (list(CATALOGUE)[seed],)
    assert case.effect_sigma > MIN_EFFECT_SIGMA or case.causes == ("sensor_scale",)
    assert all(name.startswith(case.causes[0] + ".") for name in case.sizes)
    assert 20 <= len(case.runs) <= 30


def test_pairs_show_each_and_are_not_confusable(tmp_path):
    case = draw_case("pair", 0, tmp_path)
    assert len(case.causes) == 2
    assert frozenset(case.causes) not in CONFUSABLE
    assert min(case.each_sigma[c] for c in case.causes) > MIN_EFFECT_SIGMA


@pytest.mark.slow
def test_an_unknown_is_imitated_by_no_cause(tmp_path):
    case = draw_case("unknown", 8, tmp_path, mechanism="mode_hops")
    assert case.causes == ("unknown", "mode_hops")
    assert len(case.each_sigma) == 3
    assert MIN_EFFECT_SIGMA < min(case.each_sigma.values()) <= case.effect_sigma


def check_format(path):
    with h5py.File(path) as file:
        assert file.attrs["format"] == "optotactile-recording"
        assert file.attrs["version"] == 1
        for run in file["runs"].values():
            assert 290.0 < run.attrs["ambient_K"] < 301.0
            assert isinstance(run.attrs["group"], str)
            assert run["pulses"].dtype == np.float64
            assert run["pulses"].shape[1] == 4
            names = set(run) - {"pulses", "commands"}
            assert names
            assert names <= SIGNALS
            assert ("commands" in run) == bool(names & {"mirror_x_rad", "mirror_y_rad"})
            for name in names:
                t, value = run[name]["t_s"][()], run[name]["value"][()]
                assert t.dtype == value.dtype == np.float64
                assert t.shape == value.shape
                assert len(t) <= 1500
                assert t[0] >= 0.0
                assert np.all(np.diff(t) > 0.0)
                assert np.mean(np.isnan(value)) < 0.15
                assert run[name].attrs["pixel"] >= 0
        order = [run.attrs["started_at"] for run in file["runs"].values()]
        assert order == sorted(order)
        groups = [run.attrs["group"] for run in file["runs"].values()]
        return {g: groups.count(g) for g in groups}


def test_format_and_one_more_experiment(tmp_path):
    case = draw_case("single", 35, tmp_path)
    groups = check_format(case.path)
    assert set(groups.values()) <= {2, 3, 4}
    assert "neighbour-only" in groups
    path = case.measure([[0.02, 0.05, 2.0, 0], [0.2, 0.01, 1.0, 1]], [TEMPERATURE, "mirror_x_rad"], tmp_path / "more")
    assert check_format(path) == groups | {"asked-1": 3}
    old, new = contents(case.path), contents(path)
    assert all(new[name] == value for name, value in old.items())
    with pytest.raises(ValueError, match="overlap"):
        case.measure([[0.02, 0.05, 2.0, 0], [0.03, 0.01, 1.0, 0]], [TEMPERATURE], tmp_path)
    with pytest.raises(ValueError, match="full power"):
        case.measure([[0.02, 0.05, 5.0, 0]], [TEMPERATURE], tmp_path)
    with pytest.raises(ValueError, match="block"):
        draw_case("nothing", 0, tmp_path)
    assert BLOCKS == ("none", "single", "pair", "unknown")


def case_of(block, *causes, textbook=True):
    sizes = {"bridge_conductivity": {"n": 0.5}, "gas_leak": {"rate": 1.0}}
    effects = tuple(SimpleNamespace(key=c, textbook=textbook, sizes=sizes.get(c, {})) for c in causes)
    base = {"R": 200.0, "C": 1e-4, "tau_g": 3e-3, "kappa": 4e-6, "phi": 2e-4}
    return SimpleNamespace(block=block, seed=1, causes=causes, effects=effects, base=base, effect_sigma=20.0)


def said(verdict, *causes, **more):
    return {"verdict": verdict, "causes": list(causes), "elapsed_s": 3.0, "parameters": {}, "gain": None} | more


def test_score_without_an_effect():
    case = case_of("none")
    parameters = {"R": {"value": 201.0, "ci95": [199.0, 203.0]}, "C": {"value": 1e-4, "ci95": [1.01e-4, 1.02e-4]}}
    good = score_answer(case, said("none", parameters=parameters))
    assert good.false_alarm is False
    assert good.base_inside == {"R": True, "C": False}
    assert all(score_answer(case, said(v)).false_alarm for v in ("cause", "ambiguous", "unexplained"))


def test_score_of_one_cause():
    case = case_of("single", "gas_leak")
    parameters = {"gas_leak.rate": {"value": 1.1, "ci95": [0.9, 1.3]}}
    alone = score_answer(case, said("cause", "gas_leak", parameters=parameters, gain={"reduction": 0.9}), known=0.95)
    assert (alone.alone, alone.in_set, alone.right, alone.misnamed) == (True, True, True, False)
    assert alone.term_inside == {"gas_leak.rate": True}
    assert alone.gain == pytest.approx(0.9 / 0.95)
    assert alone.worse is False
    assert not score_answer(case_of("single", "gas_leak", textbook=False), said("cause", "gas_leak")).term_inside
    warm = case_of("single", "heat_capacity")
    warm.effects[0].sizes["c"] = 0.2
    slope = {"heat_capacity.slope": {"value": 2.1e-3, "ci95": [1.9e-3, 2.3e-3]}}
    assert score_answer(warm, said("cause", "heat_capacity", parameters=slope)).term_inside == {"heat_capacity.c": True}
    two = score_answer(case, said("ambiguous", "gas_leak", "radiation"), after=said("cause", "gas_leak"))
    assert (two.alone, two.in_set, two.right, two.misnamed, two.resolved) == (False, True, None, False, True)
    three = score_answer(case, said("ambiguous", "gas_leak", "radiation", "hum"), after=said("ambiguous", "gas_leak"))
    assert (three.in_set, three.resolved) == (False, False)
    wrong = score_answer(case, said("cause", "radiation", gain={"reduction": -0.1}))
    assert (wrong.alone, wrong.in_set, wrong.right, wrong.misnamed, wrong.worse) == (False, False, False, True, True)
    more = score_answer(case, said("cause", "gas_leak", "radiation"))
    assert (more.alone, more.in_set, more.right, more.misnamed) == (False, False, None, True)
    none = score_answer(case, said("none"))
    assert (none.alone, none.in_set, none.right, none.misnamed) == (False, False, None, False)


def test_score_of_what_cannot_be_named_alone():
    case = case_of("single", "sensor_scale")
    assert score_answer(case, said("none")).scale_right
    assert score_answer(case, said("ambiguous", "sensor_scale", "gas_leak")).scale_right
    alone = score_answer(case, said("cause", "sensor_scale"))
    assert (alone.scale_right, alone.misnamed, alone.alone) == (False, True, None)


def test_score_of_unknowns_and_pairs():
    hidden = case_of("unknown", "unknown", "hum")
    assert score_answer(hidden, said("unexplained")).unexplained
    assert score_answer(hidden, said("ambiguous", "gas_leak")).misnamed
    assert score_answer(hidden, said("none")).misnamed is False
    pair = case_of("pair", "gas_leak", "bridge_conductivity")
    both = score_answer(pair, said("cause", "bridge_conductivity", "gas_leak"))
    assert (both.both, both.some_none_false, both.misnamed) == (True, True, False)
    one = score_answer(pair, said("cause", "gas_leak"))
    assert (one.both, one.some_none_false, one.misnamed) == (False, True, False)
    false = score_answer(pair, said("cause", "gas_leak", "radiation"))
    assert (false.both, false.some_none_false, false.misnamed) == (False, False, True)
    assert score_answer(pair, said("none")).some_none_false is False


def test_table_has_shares_intervals_and_aims():
    low, high = wilson(95, 100)
    assert (low, high) == (pytest.approx(0.8882, abs=1e-3), pytest.approx(0.9785, abs=1e-3))
    assert wilson(0, 0) == (0.0, 1.0)
    scores = [score_answer(case_of("none"), said(v)) for v in ("none", "none", "none", "cause")]
    scores.append(score_answer(case_of("single", "gas_leak"), said("cause", "gas_leak", gain={"reduction": 0.97})))
    text = format_table(scores)
    assert "| no hidden effect | false alarms | 1/4 | 25.0 % | 4.6 to 69.9 % | ≤ 1 % |" in text
    assert "| one cause | alone | 1/1 | 100.0 % |" in text
    assert "| two causes | both | – |" in text
    assert "| held-out gain | median | 1 | 0.970 |" in text
    assert "| single: gas_leak | 1 | 1 × cause gas_leak |" in text
