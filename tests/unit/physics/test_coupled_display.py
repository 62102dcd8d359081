"""The coupled display against an adaptive integrator, a fine trace, the nominal pixel and its energy balance."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from optodrive.device.config_sections import DisplaySection
from optodrive.device.neighbours import Neighbours
from optodrive.physics.nominal_display import NominalThermalState
from optodrive.physics.parameters import PixelArray, load_parameters
from optodrive.physics.pixel import Pixel
from reference_models.coupled_display import CoupledDisplay, Modes, WallParameters, build_conductances_w_per_k

PIXEL = Pixel(184.0, 126e-6, 0.66, 3e-3, 4e-6, 2e-4)
WALLS = WallParameters(20.0, 0.06, 430.0, 300.0)
CLOSE_WALLS = WallParameters(5.0, 0.5e-3, 30.0, 50.0)
SECTION = DisplaySection(
    rows=3,
    columns=4,
    missing=((0, 0), (1, 2)),
    pitch_m=4e-3,
    bridge_width_m=0.4e-3,
)
LATTICE = Neighbours.from_display(SECTION)


def pulses(seed, count=12, pause_s=2.0):
    """Draw pulses in order of time, with repeated pixels and one long pause."""
    rng = np.random.default_rng(seed)
    width_s = rng.integers(1, 100, count) * 2e-4
    gap_s = rng.choice([0.0, 4e-4, 3e-3, 0.02], count)
    gap_s[count // 2] = pause_s
    pixel = rng.choice([0, 1, 1, 2, 5, len(LATTICE) - 1], count)
    return pixel, np.cumsum(width_s + gap_s) - width_s, width_s, rng.uniform(0.05, 2.45, count)


def integrate(pixel, walls, columns, at_s):
    """Integrate absorber, wall and gas, [3, p], from the cold state to at_s, from edge to edge."""
    count, matrix = len(LATTICE), build_conductances_w_per_k(walls, LATTICE)
    state, now_s = np.zeros(3 * count), 0.0

    def through(power_w, to_s):
        def slope(_, flat):
            theta, wall, gas = flat.reshape(3, count)
            flow = (theta - wall) / pixel.r_k_per_w
            return np.concatenate(
                [
                    (pixel.epsilon * power_w - flow) / pixel.c_j_per_k,
                    (flow - matrix @ wall) / walls.c_j_per_k,
                    ((theta + wall) / 2 - gas) / pixel.tau_g_s,
                ]
            )

        if to_s <= now_s:
            return state
        return solve_ivp(slope, (now_s, to_s), state, method="DOP853", rtol=1e-10, atol=1e-12).y[:, -1]

    for index, start_s, width_s, power_w in zip(*columns, strict=True):
        state, now_s = through(np.zeros(count), start_s), start_s
        state, now_s = through(power_w * (np.arange(count) == index), start_s + width_s), start_s + width_s
    return through(np.zeros(count), at_s).reshape(3, count)


@pytest.mark.parametrize("walls", [WALLS, CLOSE_WALLS], ids=["laminate", "close"])
@pytest.mark.parametrize("dark_s", [0.0, 4e-3, 0.3])
def test_meets_an_integrator(walls, dark_s):
    columns = pulses(1)
    heat = CoupledDisplay(Modes.diagonalise(PIXEL, walls, LATTICE))
    result = heat.apply_pulses(*columns)
    at_s = columns[1][-1] + columns[2][-1] + dark_s
    exact = integrate(PIXEL, walls, columns, at_s)
    assert np.array(heat.rises_k(at_s)) == pytest.approx(exact, rel=1e-8, abs=1e-9)
    if dark_s == 0.0:
        assert result.wall_k[-1] == pytest.approx(exact[1, columns[0][-1]], rel=1e-8)


@pytest.mark.parametrize("motion", ["first_per_s", "second_per_s"])
@pytest.mark.parametrize("off", [0.0, 1e-12, 3e-9, -2e-8, 1e-4])
def test_gas_as_slow_as_a_mode(motion, off):
    rate = getattr(Modes.diagonalise(PIXEL, CLOSE_WALLS, LATTICE), motion)[3]
    pixel = PIXEL._replace(tau_g_s=(1.0 + off) / rate)
    columns = pulses(2, count=5)
    heat = CoupledDisplay(Modes.diagonalise(pixel, CLOSE_WALLS, LATTICE))
    heat.apply_pulses(*columns)
    at_s = columns[1][-1] + columns[2][-1] + 2e-3
    expected = integrate(pixel, CLOSE_WALLS, columns, at_s)
    assert np.array(heat.rises_k(at_s)) == pytest.approx(expected, rel=1e-6, abs=1e-7)


def trace(walls, columns):
    """Sample absorber and gas [m, p] every 20 µs through all pulses and for a while after each, with the times [m]."""
    heat, step_s, dark_s = CoupledDisplay(Modes.diagonalise(PIXEL, walls, LATTICE)), 2e-5, 0.03
    t_s, absorber_k, gas_k = [0.0], [np.zeros(len(LATTICE))], [np.zeros(len(LATTICE))]

    def record(at_s):
        absorber, _, gas = heat.rises_k(at_s)
        for values, value in ((t_s, at_s), (absorber_k, absorber), (gas_k, gas)):
            values.append(value)

    ends_s = [*columns[1][1:], columns[1][-1] + 1.0]
    for pixel, start_s, width_s, power_w, until_s in zip(*columns, ends_s, strict=True):
        for at_s in start_s + step_s * np.arange(round(width_s / step_s)):
            heat.apply_pulses(*(np.array([value]) for value in (pixel, at_s, step_s, power_w)))
            record(at_s + step_s)
        end_s = start_s + width_s
        for at_s in np.arange(end_s + step_s, min(until_s, end_s + dark_s), step_s):
            record(at_s)
        record(until_s)
    return np.array(t_s), np.array(absorber_k), np.array(gas_k)


@pytest.mark.parametrize(("walls", "rel"), [(WALLS, 3e-6), (CLOSE_WALLS, 1e-3)], ids=["laminate", "close"])
def test_peaks_meet_a_fine_trace(walls, rel):
    # The time of the peak assumes a constant wall: exact for the laminate, not for walls as fast as the gas.
    columns = pixel, start_s, _, power_w = pulses(3, pause_s=0.1)
    pixel[3], power_w[3] = pixel[2], 0.01
    peaks = CoupledDisplay(Modes.diagonalise(PIXEL, walls, LATTICE)).apply_pulses(*columns)
    t_s, absorber_k, gas_k = trace(walls, columns)
    for row, index in enumerate(pixel):
        following = start_s[row + 1 :][pixel[row + 1 :] == index]
        during = (t_s >= start_s[row] - 1e-9) & (t_s <= (following[0] if len(following) else np.inf) + 1e-9)
        highest_m = PIXEL.kappa_m_per_k * gas_k[during, index].max()
        assert peaks.displacement_m[row] == pytest.approx(highest_m, rel=rel), row
        assert peaks.absorber_k[row] == pytest.approx(absorber_k[during, index].max(), rel=1e-9), row


def test_energy_closes():
    pixel, start_s, width_s, power_w = pulses(4, count=8)
    heat, matrix = (
        CoupledDisplay(Modes.diagonalise(PIXEL, CLOSE_WALLS, LATTICE)),
        build_conductances_w_per_k(CLOSE_WALLS, LATTICE),
    )
    leak_w = matrix.sum(axis=0)
    left_j, now_s, before_w = 0.0, 0.0, 0.0

    def span(to_s, light_w, index):
        """Integrate the leaking power over an interval of constant power by Simpson's rule."""
        nonlocal left_j, now_s, before_w
        steps = 2 * max(1, round((to_s - now_s) / 4e-4))
        flows_w, step_s = [before_w], (to_s - now_s) / steps
        for step in range(steps):
            if light_w:
                heat.apply_pulses(*(np.array([v]) for v in (index, now_s + step * step_s, step_s, light_w)))
            flows_w.append(float(leak_w @ heat.rises_k(now_s + (step + 1) * step_s)[1]))
        left_j += step_s / 3 * (flows_w[0] + flows_w[-1] + 4 * sum(flows_w[1:-1:2]) + 2 * sum(flows_w[2:-1:2]))
        now_s, before_w = to_s, flows_w[-1]

    for index, begin_s, on_s, light_w in zip(pixel, start_s, width_s, power_w, strict=True):
        span(begin_s, 0.0, index)
        span(begin_s + on_s, light_w, index)
    absorbed_j = PIXEL.epsilon * float(power_w @ width_s)
    for dark_s in (0.0, 0.02, 0.5):
        span(start_s[-1] + width_s[-1] + dark_s, 0.0, 0)
        absorber_k, wall_k, _ = heat.rises_k(now_s)
        stored_j = PIXEL.c_j_per_k * absorber_k.sum() + CLOSE_WALLS.c_j_per_k * wall_k.sum()
        assert stored_j + left_j == pytest.approx(absorbed_j, rel=1e-6)


def test_walls_held_at_ambient_are_the_nominal_pixel():
    columns = pulses(5, count=200)
    heat = CoupledDisplay(Modes.diagonalise(PIXEL, WallParameters(1e-9, 0.06, np.inf, np.inf), LATTICE))
    nominal = NominalThermalState(PixelArray.uniform(PIXEL, len(LATTICE)))
    peaks, expected = heat.apply_pulses(*columns), nominal.apply_pulses(*columns)
    assert peaks.displacement_m == pytest.approx(expected.displacement_m, rel=1e-9)
    assert peaks.absorber_k == pytest.approx(expected.absorber_k, rel=1e-9)
    at_s = columns[1][-1] + columns[2][-1] + 0.01
    absorber_k, wall_k, gas_k = heat.rises_k(at_s)
    each = np.array([nominal.rises_k(pixel, at_s) for pixel in range(len(LATTICE))])
    assert np.stack([absorber_k, gas_k], axis=1) == pytest.approx(each, rel=1e-8, abs=1e-8)
    assert np.abs(wall_k).max() < 1e-8


def test_split_pulses_are_one():
    whole, halves = (CoupledDisplay(Modes.diagonalise(PIXEL, WALLS, LATTICE)) for _ in range(2))
    whole.apply_pulses(np.array([4]), np.array([0.1]), np.array([0.02]), np.array([2.0]))
    halves.apply_pulses(np.array([4, 4]), np.array([0.1, 0.11]), np.array([0.01, 0.01]), np.array([2.0, 2.0]))
    assert np.array(halves.rises_k(0.15)) == pytest.approx(np.array(whole.rises_k(0.15)), rel=1e-12, abs=1e-13)


def test_long_darkness_cools_to_nothing():
    heat = CoupledDisplay(Modes.diagonalise(PIXEL, WALLS, LATTICE))
    heat.apply_pulses(*pulses(6))
    assert np.abs(heat.rises_k(1e6)).max() < 1e-100


def test_times_before_the_last_event_and_pixels_that_are_not_are_refused():
    heat = CoupledDisplay(Modes.diagonalise(PIXEL, WALLS, LATTICE))
    with pytest.raises(ValueError, match=r"advanced to 0\.02 s, 0\.01 s lies before"):
        heat.apply_pulses(np.array([0, 1]), np.array([0.0, 0.01]), np.array([0.02, 0.02]), np.array([1.0, 1.0]))
    with pytest.raises(ValueError, match=r"advanced to 0\.02 s"):
        heat.rises_k(0.01)
    with pytest.raises(IndexError, match="10 to 10 of 10"):
        heat.apply_pulses(np.array([10]), np.array([1.0]), np.array([0.02]), np.array([1.0]))


def test_walls_come_from_a_parameter_set():
    assert WallParameters.from_parameters(load_parameters("surroundings")) == WallParameters(20.0, 0.06, 430.0, 430.0)
