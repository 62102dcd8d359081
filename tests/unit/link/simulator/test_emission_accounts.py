"""The accounts of B5 and B6 in the simulated board, and the times that it takes from the contract."""

import random
import tomllib
from pathlib import Path

from optodrive.link.simulator import board_machine as machine_module
from optodrive.link.simulator.board_core import TICK_HZ
from optodrive.link.simulator.guards import DEFAULT_LIMITS, DUTY_FULL, WINDOW_US, EmissionGuards, energy_uj
from optodrive.link.simulator.point_queue import RING_RECORDS


def test_the_timing_of_the_contract():
    contract = Path(__file__).parents[4] / "firmware_protocol" / "messages.toml"
    timing = tomllib.loads(contract.read_text())["timing"]
    assert timing == {
        "tick_hz": TICK_HZ,
        "indicator_us": machine_module.INDICATOR_US,
        "arming_timeout_us": machine_module.ARMING_TIMEOUT_US,
        "hold_max_us": machine_module.HOLD_MAX_US,
        "underruns_max": machine_module.UNDERRUNS_MAX,
        "underrun_window_us": machine_module.UNDERRUN_WINDOW_US,
        "mean_window_us": WINDOW_US,
        "executed_ring": RING_RECORDS,
    }


def in_second_before(end_us, pulses):
    """Return gate-on time × duty in the second before end_us."""
    return sum(max(0, min(t + on, end_us) - max(t, end_us - WINDOW_US)) * duty for t, on, duty in pulses)


def test_mean_account_is_the_fullest_second_of_all():
    rng = random.Random(4)
    for _ in range(20):
        guards, pulses, at_us = EmissionGuards(1300, 9, 999), [], 0
        for _ in range(60):
            at_us += rng.randrange(0, 60_000)
            on_us, duty = rng.randrange(1, 50_000), rng.choice([100, 20_000, DUTY_FULL])
            account, before = guards.max_window_duty_us(at_us, on_us, duty), in_second_before(at_us, pulses)
            pulses = [*pulses, (at_us, on_us, duty)]
            kinks = [t + WINDOW_US for t, _, _ in pulses] + [t + on + WINDOW_US for t, on, _ in pulses]
            ends = [at_us + on_us, *rng.choices(range(at_us + 1, at_us + on_us + 1), k=5)]
            ends += [end_us for end_us in kinks if at_us < end_us < at_us + on_us]
            fullest = max(in_second_before(end_us, pulses) for end_us in ends)
            assert account in [in_second_before(end_us, pulses) for end_us in ends]
            assert fullest <= max(account, before)
            guards.record_pulse(DEFAULT_LIMITS, 0, 0, at_us, on_us, duty)
            at_us += on_us


def test_energy_is_rounded_up_and_full_duty_is_full_power():
    assert energy_uj(DEFAULT_LIMITS, 50_000, DUTY_FULL) == 122_500
    assert energy_uj(DEFAULT_LIMITS, 1, 1) == 1
    assert energy_uj(DEFAULT_LIMITS, 0, DUTY_FULL) == 0
