"""B17 on the simulated board: mirrors follow with the configured servo at the board's settling time, or cease to.

`python -m pytest -s -m slow tests/unit/link/simulator/test_measured_mirrors.py` plays an hour.
"""

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.device.config import Config
from optodrive.device.field_loader import load_scan_field
from optodrive.device.pixel_map import build_aim_layout
from optodrive.link.board_setup import build_board_requirements, build_port_settings
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.states import BoardState
from optodrive.link.simulator import galvos as galvos_module
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.galvos import SimulatedGalvos
from optodrive.link.simulator.guards import build_settings
from optodrive.link.simulator.measured_mirrors import MIRROR_FAULTS

OFF_MAX_US = 1000
SEEDS = 4
BEGIN_US = 2_200_000
ON_US, DUTY = 2_000, 600
PULSES = 2_000
HOUR_US, PIECES = 3_600_000_000, 12


@pytest.fixture(scope="module")
def config():
    table = DISPLAYS["display-16"].config.model_dump()
    table["scanner"] |= {"feedback": True}
    return Config.model_validate(table)


class Show:
    """An armed board with simulated galvos that lights pixels in random order, each as soon as the mirrors settle."""

    def __init__(self, config, seed=1):
        (self._scale,) = [build_board_requirements(config).scale]
        layout = build_aim_layout(config)
        angles_rad = load_scan_field(config).angles_rad(layout.x_m, layout.y_m)
        self.codes = np.column_stack(self._scale.to_outputs(*(self._scale.to_codes(each) for each in angles_rad)))
        self._random, self._queued, self.pulses, self.log = np.random.default_rng(seed), 0, 0, []
        galvos = SimulatedGalvos(config, seed)
        settings = build_settings(build_port_settings(config).own_settings)
        self.core = BoardCore(settings, self._on_event, seed, galvos.move_to, galvos.measure)
        self.machine = self.core.machine
        self.machine.begin_session(True)
        self.advance(20_000)
        assert self.machine.request_arming(1) == ""
        assert self.machine.confirm_arming(*self.machine.challenge) == ""
        self.advance(BEGIN_US)
        self._refill()
        assert self.machine.start_job(m.Start(1, 0, 0, 1)) == ""

    def _on_event(self, event):
        if event["event"] == "pulse":
            self.pulses, self.log = self.pulses + 1, [*self.log[-9:], event]

    def _refill(self):
        places = self._random.integers(len(self.codes), size=PULSES)
        points = [(*self.codes[k].tolist(), 0, ON_US, DUTY) for k in places]
        assert self.machine.queue_points(self._queued, points) == ""
        self._queued += len(points)

    def advance(self, until_us):
        """Advance, with a lease and points as long as the board runs."""
        for at_us in range(self.machine.now_us + 20_000, until_us + 1, 20_000):
            self.machine.renew_lease(100)
            if self.machine.state == BoardState.RUNNING and len(self.machine.queue) < PULSES:
                self._refill()
            self.core.advance(at_us)
        self.core.advance(until_us)


@pytest.mark.parametrize("fault", MIRROR_FAULTS)
def test_each_fault_of_a_mirror_turns_the_gate_off_within_a_millisecond(config, fault):
    slowest_us, codes = 0, build_board_requirements(config).feedback_codes
    for seed in range(SEEDS):
        show = Show(config, seed)
        show.advance(BEGIN_US + 40_000 + 437 * seed)
        assert show.machine.state == BoardState.RUNNING
        fault_us = show.machine.now_us
        x, _ = show.core.mirrors.read(fault_us)
        show.core.inject_fault(fault, fault_us)
        show.core.advance(fault_us + 60_000)
        assert show.machine.fault == "SCAN"
        for pulse in show.log:
            if pulse["off_us"] > fault_us and (fault == "unplug_mirror" or abs(pulse["x"] - x) > codes):
                slowest_us = max(slowest_us, pulse["off_us"] - max(pulse["on_us"], fault_us))
    print(f"{fault}: light beside its position for {slowest_us} µs at most")
    assert slowest_us <= OFF_MAX_US


@pytest.mark.slow
@pytest.mark.timeout(1500)
@pytest.mark.parametrize("piece", range(1, PIECES + 1), ids="hour-{}".format)
def test_no_false_stop_in_an_hour(config, monkeypatch, piece):
    monkeypatch.setattr(galvos_module, "MOVE_HISTORY_S", 0.05)  # 50 times the servo's period, and faster
    show = Show(config, piece)
    show.advance(BEGIN_US + HOUR_US // PIECES)
    print(f"{show.pulses} pulses, state {show.machine.state}, fault '{show.machine.fault}'")
    assert (show.machine.state, show.machine.fault) == (BoardState.RUNNING, "")
    assert show.pulses > 1_000_000 // PIECES


def test_a_laser_dac_measures_no_mirrors(config):
    table = config.model_dump()
    table["scanner"] |= {"half_range_codes": 2047}
    table["board"] |= {"transport": "helios"}
    with pytest.raises(ValueError, match=r"scanner\.feedback: 'true', expected false"):
        Config.model_validate(table)
