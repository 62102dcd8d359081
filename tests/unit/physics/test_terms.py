"""Each term against SciPy's solver at tight tolerance, and in the limits where it must vanish."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from optodrive.core.errors import InputError
from optodrive.device.config import DisplaySection
from optodrive.device.neighbours import Neighbours
from optodrive.physics import terms
from optodrive.physics.numpy_model import Drive, Model
from optodrive.physics.parameters import PixelArray
from optodrive.physics.pixel import Pixel, advance
from optodrive.physics.terms import discover_terms

PIXEL = Pixel(184.0, 126e-6, 0.66, 3e-3, 4e-6, 2.3e-4)
LATTICE = Neighbours.from_display(
    DisplaySection(rows=2, columns=3, pitch_m=4e-3, missing=((0, 0),), bridge_width_m=4e-4)
)
AMBIENT_K = 293.15
VALUES = {
    "bridge_conductivity": {"exponent": 0.6},
    "wall_heating": {"resistance": 20.0, "capacity": 0.01},
    "lateral_conduction": {"resistance": 60.0, "frame_resistance": 90.0},
    "touch_surface": {"gas_share": 0.3, "wall_share": 0.4, "lag": 0.5},
    "gas_membrane": {"share": 0.35, "volume": 7.8e-9},
    "force_area": {"area": 1e-6, "share": 0.35},
}
SETS = {key: [key] for key in VALUES} | {"lateral_conduction": ["wall_heating", "lateral_conduction"], "all": VALUES}
LIT_W = np.array([2.45, 0.0, 1.0, 0.0, 0.3])
DRIVES = (Drive(0.002, LIT_W), Drive(0.040, 0.0 * LIT_W), Drive(0.060, LIT_W[::-1].copy()), Drive(0.075, 0.0 * LIT_W))
T_S = np.array([0.002, 0.015, 0.040, 0.050, 0.075, 0.2])


def model(keys, **changed):
    values = {key: VALUES[key] | changed.get(key, {}) for key in keys}
    return Model(PixelArray.uniform(PIXEL, len(LATTICE)), values, AMBIENT_K, LATTICE)


def written_out(keys, y, power_w):
    """dy/dt of y [4, p] absorber, gas, wall, touch surface, written out without any of the package."""
    absorber, gas, wall, touch = y
    walls, lateral, surface = (
        VALUES[key] if key in keys else None for key in ("wall_heating", "lateral_conduction", "touch_surface")
    )
    exponent = VALUES["bridge_conductivity"]["exponent"] if "bridge_conductivity" in keys else 0.0
    resistance = 184.0 * ((AMBIENT_K + (absorber + wall) / 2) / AMBIENT_K) ** exponent
    bridge = (absorber - wall) / resistance
    leaves = wall / walls["resistance"] if walls else bridge
    if lateral:
        # Pixels 0 1 in the upper columns of the first row, 2 3 4 in the second.
        for one, other in ((0, 1), (2, 3), (3, 4), (0, 3), (1, 4)):
            sent = (wall[one] - wall[other]) / lateral["resistance"]
            leaves = leaves + sent * (np.arange(5) == one) - sent * (np.arange(5) == other)
        leaves = leaves + np.array([1, 2, 2, 1, 2]) * wall / lateral["frame_resistance"]
    follows = surface["gas_share"] * gas + surface["wall_share"] * wall - touch if surface else 0.0 * touch
    return np.array(
        [
            (0.66 * power_w - bridge) / 126e-6,
            ((absorber + wall) / 2 - gas) / 3e-3,
            (bridge - leaves) / (walls["capacity"] if walls else 1.0),
            follows / (surface["lag"] if surface else 1.0),
        ]
    )


def by_scipy(keys):
    """States at T_S by an explicit solver of the eighth order, segment by segment."""
    edges = [0.0, *(drive.start_s for drive in DRIVES), 0.2]
    powers = [0.0 * LIT_W, *(drive.power_w for drive in DRIVES)]
    state, kept = np.zeros(20), {}
    for begin, end, power in zip(edges[:-1], edges[1:], powers, strict=True):
        solved = solve_ivp(
            lambda _, y, power=power: written_out(keys, y.reshape(4, 5), power).ravel(),
            (begin, end),
            state,
            method="DOP853",
            rtol=1e-11,
            atol=1e-11,
            t_eval=sorted({*(t for t in T_S if begin < t <= end), end}),
        )
        kept |= dict(zip(solved.t, solved.y.T, strict=True))
        state = solved.y[:, -1]
    return np.array([kept[t].reshape(4, 5) for t in T_S])


@pytest.mark.parametrize("name", SETS)
def test_states_agree_with_scipy(name):
    exact = by_scipy(SETS[name])
    traced = model(SETS[name]).trace(DRIVES, T_S)
    for row, state in enumerate(("absorber_k", "gas_k", "wall_k", "touch_k")):
        if state in traced.rise_k:
            largest_k = np.abs(exact[:, row]).max()
            assert traced.rise_k[state] == pytest.approx(exact[:, row], rel=1e-6, abs=1e-6 * largest_k)


def test_without_terms_it_is_the_nominal_pixel():
    traced = model([]).trace(DRIVES[:2], np.array([0.040, 0.060]))
    lit = advance(PIXEL, 0.0, 0.0, 2.45, 0.038)
    dark = advance(PIXEL, *lit, 0.0, 0.020)
    assert traced.rise_k["absorber_k"][:, 0] == pytest.approx([lit[0], dark[0]], rel=1e-7)
    assert traced.rise_k["gas_k"][:, 0] == pytest.approx([lit[1], dark[1]], rel=1e-7)
    assert traced.displacement_m[:, 0] == pytest.approx(4e-6 * traced.rise_k["gas_k"][:, 0])


@pytest.mark.parametrize(
    "term",
    [
        {"bridge_conductivity": {"exponent": 0.0}},
        {"wall_heating": {"resistance": 1e-6, "capacity": 0.01}},
    ],
    ids=str,
)
def test_a_term_at_its_limit_is_the_nominal_pixel(term):
    made = Model(PixelArray.uniform(PIXEL, 1), term, AMBIENT_K)
    # This wall would move at once: its rate, not its motion, is looked at.
    nominal = Model(PixelArray.uniform(PIXEL, 1), {}, AMBIENT_K)
    state = np.zeros((len(made.states), 1))
    state[0], state[1] = 200.0, 80.0
    power = np.array([2.0])
    assert made.rates(state, power).state_per_s[:2] == pytest.approx(nominal.rates(state[:2], power).state_per_s)
    if "wall_heating" in term:
        steady = 200.0 / PIXEL.r_k_per_w * 1e-6
        assert steady < 2e-6  # K: what the wall settles at


def test_a_wall_that_hardly_resists_hardly_moves_the_pixel():
    sunk = Model(PixelArray.uniform(PIXEL, 1), {"wall_heating": {"resistance": 1e-4, "capacity": 20.0}}, AMBIENT_K)
    traced = sunk.trace([Drive(0.0, np.array([2.45]))], np.array([0.010, 0.040]))
    for row, at_s in enumerate(traced.t_s):
        absorber_k, gas_k = advance(PIXEL, 0.0, 0.0, 2.45, at_s)
        assert traced.rise_k["absorber_k"][row, 0] == pytest.approx(absorber_k, rel=1e-6)
        assert traced.rise_k["gas_k"][row, 0] == pytest.approx(gas_k, rel=2e-6)


def test_walls_as_good_as_one_share_the_mean_power():
    # The step must follow what neighbours exchange, far quicker here than anything a single pixel does.
    wall = {"wall_heating": {"resistance": 20.0, "capacity": 0.0025}}
    whole = Neighbours.from_display(DisplaySection(rows=2, columns=3, pitch_m=4e-3, bridge_width_m=4e-4))
    sides = {"lateral_conduction": {"resistance": 0.05, "frame_resistance": 1e12}}
    joined = Model(PixelArray.uniform(PIXEL, 6), wall | sides, AMBIENT_K, whole)
    alone = Model(PixelArray.uniform(PIXEL, 1), wall, AMBIENT_K)
    walls, one = (
        made.trace([Drive(0.0, power_w)], np.array([0.002, 0.03])).rise_k["wall_k"]
        for made, power_w in ((joined, np.array([2.4, 0, 0, 0, 0, 0])), (alone, np.array([0.4])))
    )
    assert walls.mean(axis=1) == pytest.approx(one[:, 0], rel=1e-6)
    assert np.ptp(walls[-1]) < 0.05 * one[-1, 0]


def test_variants_side_by_side_are_variants_by_themselves():
    shares = np.array([0.2, 0.3, 0.45])
    varied = {key: VALUES[key] for key in ("bridge_conductivity", "wall_heating", "touch_surface")}
    membrane = VALUES["gas_membrane"]
    together = Model(PixelArray.uniform(PIXEL, 3), varied | {"gas_membrane": membrane | {"share": shares}}, AMBIENT_K)
    drive = [Drive(0.0, np.full(3, 2.0))]
    heights_m = together.trace(drive, T_S).displacement_m
    for column, share in enumerate(shares):
        one = Model(PixelArray.uniform(PIXEL, 1), varied | {"gas_membrane": membrane | {"share": share}}, AMBIENT_K)
        alone_m = one.trace([Drive(0.0, np.full(1, 2.0))], T_S).displacement_m
        assert heights_m[:, column] == pytest.approx(alone_m[:, 0], rel=1e-9)


def test_equal_walls_send_each_other_nothing():
    alone, beside = (
        model(["wall_heating"]),
        model(SETS["lateral_conduction"], lateral_conduction={"frame_resistance": 1e12}),
    )
    state = np.full((3, len(LATTICE)), 50.0)
    power = np.zeros(len(LATTICE))
    assert beside.rates(state, power).state_per_s == pytest.approx(alone.rates(state, power).state_per_s, rel=1e-9)


def test_walls_far_apart_are_walls_alone():
    beside = model(SETS["lateral_conduction"], lateral_conduction={"resistance": 1e12, "frame_resistance": 1e12})
    assert beside.trace(DRIVES, T_S).rise_k["wall_k"] == pytest.approx(
        model(["wall_heating"]).trace(DRIVES, T_S).rise_k["wall_k"], rel=1e-7, abs=1e-9
    )


def test_the_membrane_balances_its_gas():
    made = model(["gas_membrane"])
    state = made.cold_states()
    state[1] = [-5.0, 0.0, 1.0, 20.0, 250.0]
    z_m = made.outputs(state)[0]
    assert z_m[1] == 0.0
    assert (np.diff(z_m) > 0).all()
    e, nu, h, r = 50e3, 0.49, 0.25e-3, 1.5e-3
    held = 16 * e * h**3 * z_m / (3 * (1 - nu**2) * r**4) + 8 * e * h * z_m**3 / (3 * (1 - nu) * r**4)
    gas_k = 2 * 0.35 * state[1]
    pushed = 101_325 * ((AMBIENT_K + gas_k) / AMBIENT_K / (1 + 0.5 * np.pi * r**2 * z_m / 7.8e-9) - 1)
    assert pushed == pytest.approx(held, rel=1e-9, abs=1e-6)


def test_a_small_bulge_is_held_by_the_plate_and_the_gas_alone():
    made = model(["gas_membrane"])
    state = made.cold_states()
    state[1] = 1e-6
    e, nu, h, r = 50e3, 0.49, 0.25e-3, 1.5e-3
    stiffness = 16 * e * h**3 / (3 * (1 - nu**2) * r**4) + 101_325 * 0.5 * np.pi * r**2 / 7.8e-9
    assert made.outputs(state)[0] == pytest.approx(101_325 * 0.7e-6 / AMBIENT_K / stiffness, rel=1e-4)


def test_the_whole_aperture_at_half_the_rise_is_the_force_of_text_s1():
    aperture_m2 = np.pi * 1.5e-3**2
    made = Model(PixelArray.uniform(PIXEL, 1), {"force_area": {"area": aperture_m2, "share": 0.5}}, 300.0)
    state = made.cold_states()
    state[1] = 116.0
    assert made.outputs(state)[1] == pytest.approx(2.387e-3 * 116.0, rel=1e-3)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"wall_heeting": {}}, "a known term, nearest is 'wall_heating'"),
        ({"touch_surface": {"lag": 1.0, "gas_share": 0.3, "wall_sharr": 0.4}}, "nearest is 'wall_share'"),
        ({"wall_heating": {"resistance": 20.0}}, r"terms\.wall_heating\.capacity: got None"),
    ],
)
def test_mistaken_values_are_refused_in_one_line(values, said):
    with pytest.raises(InputError, match=said) as caught:
        Model(PixelArray.uniform(PIXEL, 1), values, AMBIENT_K)
    assert "\n" not in str(caught.value)


def test_a_term_without_the_one_it_builds_on_is_refused():
    with pytest.raises(InputError, match=r"terms\.lateral_conduction: .* expected terms\.wall_heating"):
        model(["lateral_conduction"])


def test_every_file_of_the_package_is_a_term():
    terms = discover_terms()
    assert set(VALUES) <= set(terms)
    for key, term in terms.items():
        assert term.key == key
        assert term.parameters
        for parameter in term.parameters:
            assert parameter.low <= parameter.default <= parameter.high
            assert parameter.source


def test_a_new_term_is_a_new_file_and_nothing_else(tmp_path, monkeypatch):
    (tmp_path / "leak.py").write_text(
        "from optodrive.physics.term import Term, TermParameter\n"
        "class Leak(Term):\n"
        "    key = 'leak'\n"
        "    parameters = (TermParameter('resistance', 'K/W', 100.0, 1.0, 1e6, 'here'),)\n"
        "    def flow(self, values, view, flows):\n"
        "        flows.move('absorber_k', None, view.rise_k['absorber_k'] / values['resistance'])\n"
        "TERM = Leak()\n"
    )
    monkeypatch.setattr(terms, "__path__", [*terms.__path__, str(tmp_path)])
    discover_terms.cache_clear()
    try:
        leaky = Model(PixelArray.uniform(PIXEL, 1), {"leak": {"resistance": PIXEL.r_k_per_w}}, AMBIENT_K)
        traced = leaky.trace([Drive(0.0, np.array([2.0]))], np.array([0.5]))
    finally:
        monkeypatch.undo()
        discover_terms.cache_clear()
    assert traced.rise_k["absorber_k"][0, 0] == pytest.approx(0.5 * PIXEL.epsilon * 2.0 * PIXEL.r_k_per_w)
    assert traced.absorbed_j == pytest.approx(traced.stored_j + traced.left_j)
