"""The accounts of B5 and B6 in the simulated board, and the times that it takes from the contract."""

import tomllib
from pathlib import Path

from optodrive.link.simulator import board_machine as machine_module
from optodrive.link.simulator.board_core import TICK_HZ
from optodrive.link.simulator.guards import WINDOW_US
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
