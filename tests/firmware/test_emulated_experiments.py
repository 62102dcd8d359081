"""The paper's experiments through the real planner, queue and link service to boards on emulated chips."""

import numpy as np
import pytest
from emulated_pico import PicoImage
from emulated_usb_pico import EmulatedUsbPico

from displays import DISPLAYS
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.session.board_group import BoardGroup
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.virtual_run import MemoryLink
from optodrive.planning import heat_record
from optodrive.planning.stimuli.pattern_registry import build_pattern
from planner_rig import PlannerRig

DISPLAY = DISPLAYS["display-437"]
PWM_S = 2e-4
BOOT_US = 50_000
EXPERIMENTS = [
    *(pytest.param(name, given, count, marks=pytest.mark.slow) for name, given, count in (
        ("experiment-1", {"direction": "right"}, 24),
        ("experiment-2", {"direction": "cw", "speed": 16}, 16),
        ("experiment-3", {"target": 3}, 20),
        ("experiment-4", {"level": 9}, 20),
        ("experiment-5", {"oddball": 2, "kind": "fast", "pause_s": 0.5}, 32),
    )),
    ("experiment-6", {"digits": "2-3"}, 40),
]  # fmt: skip


class ChipRig(PlannerRig):
    """The chip as the board of a display."""

    def __init__(self, monkeypatch, make_chip):
        self._make_chip = make_chip
        super().__init__(monkeypatch, display=DISPLAY, requirements=build_board_requirements(DISPLAY.config))

    def build_boards(self, _, settings, requirements):
        self.chip = self._make_chip(settings, self.log.append, seed=3)
        self.link = MemoryLink(self.chip, self.clock)
        self.session = BoardSession(self.link, self.clock, requirements)
        return BoardGroup([self.session], self.clock, [self.open_port])


def check_executed(rig, name, given, count):
    """Play an experiment of `count` pulses on an armed board. Check what it emitted against the plan."""
    rig.run(0.01)
    planned = rig.submit(build_pattern(name, given, DISPLAY.config), rig.remote.epoch).result()
    record = rig.store.find(planned.plan)
    plan = rig.queue.state.waiting[0].planned.plan
    rig.until(lambda: record.has_ended)
    assert (record.status, record.error, record.executed_count) == ("done", None, count)
    pulses = [event for event in rig.log if event["event"] == "pulse"]
    on_us, off_us, codes = (
        np.array([[pulse[key] for key in keys] for pulse in pulses]) for keys in (("on_us",), ("off_us",), ("x", "y"))
    )
    assert len(pulses) == count
    assert np.diff(on_us[:, 0]) * 1e-6 == pytest.approx(np.diff(plan.start_s), abs=PWM_S)
    assert (off_us - on_us)[:, 0] * 1e-6 == pytest.approx(plan.width_s, abs=PWM_S)
    scale = rig.session.scale
    assert codes.tolist() == np.column_stack([scale.to_codes(plan.x_rad), scale.to_codes(plan.y_rad)]).tolist()
    assert not [event for event in rig.log if event["event"] == "fault"]
    rig.chip.close()


@pytest.mark.parametrize(("name", "given", "count"), EXPERIMENTS)
def test_an_experiment_is_executed_as_planned(monkeypatch, chips, name, given, count):
    check_executed(ChipRig(monkeypatch, chips(0)).ready().arm(), name, given, count)


@pytest.mark.slow
def test_experiment_1_is_executed_by_a_pico_on_its_usb_port(monkeypatch, tmp_path):
    """The image has its own settings, with which the key must be turned before each arming, and its own uid."""
    image = PicoImage(tmp_path)
    monkeypatch.setattr(heat_record, "LIGHTLESS", heat_record.LIGHTLESS | {b"rp2040-00001".hex()})

    def make_pico(settings, sink, seed):
        pico = EmulatedUsbPico(image, settings, sink, seed)
        pico.set_input("key", False, 0)
        pico.set_input("key", True, BOOT_US)
        pico.open_port(BOOT_US)
        return pico

    check_executed(ChipRig(monkeypatch, make_pico).ready().arm(), "experiment-1", {"direction": "right"}, 24)
