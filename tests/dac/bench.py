"""Test bench of the laser DACs: configuration, emulated Helios, driver and plans."""

from functools import cache

import numpy as np

from dac.emulated_helios import EmulatedHelios
from optodrive.core.clock import ManualClock
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.device.config import Config
from optodrive.device.config_file import load_config
from optodrive.link.dac.devices.helios import Helios
from optodrive.link.dac.encoding import PointScale, decode, encode
from optodrive.link.dac.laser_dac import build_uid
from optodrive.link.dac.player import VerifiedChunks, encode_verified
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.heat_record import HeatRecord
from optodrive.planning.pipeline import plan_sequence


def build_config(name="display-16", trajectories="steps", **board):
    """Return a shipped configuration with a Helios DAC."""
    table = load_config(name).model_dump()
    table["board"] |= {"transport": "helios", "interlock_watched": True} | board
    table["scanner"] |= {"half_range_codes": 2047, "trajectories": trajectories}
    return Config.model_validate(table)


@cache
def build_display(name="display-16", points_per_s=40_000):
    return DisplayModel.from_config(build_config(name, points_per_s=points_per_s))


@cache
def build_network_display(transport, name="display-16", points_per_s=40_000, trajectories="steps"):
    config = build_config(name, trajectories, transport=transport, points_per_s=points_per_s, port="dac")
    return DisplayModel.from_config(config)


def raw_points(data):
    """Return the points of a Helios' frame, [n, 7] bytes, without this package's parser."""
    return np.frombuffer(data[:-5], dtype=np.uint8).reshape(-1, 7)


def build_frame(display, height_m=20e-6, duration_s=1.0):
    return FrameSequence((TactileFrame("f", 0.0, duration_s, np.full(len(display.pixels), height_m)),))


def build_train(width_s=0.02, gap_s=0.02, power_w=1.0, pixel=5, duration_s=0.3):
    return FrameSequence(trains=(PulseTrain(pixel, 0.0, duration_s, width_s, gap_s, power_w),))


def build_verified(display, sequence, proven=True):
    """Return a plan and its verified chunks, or chunks that no proof has seen."""
    heat, budget = display.build_cold_state()
    plan = plan_sequence(display, sequence, heat, budget).plan
    if not proven:
        scale = PointScale.from_config(display.config)
        chunks = encode(plan, scale)
        return plan, VerifiedChunks(chunks, decode([chunk.data for chunk in chunks], scale), np.zeros(0, dtype=int))
    return plan, encode_verified(plan, PointScale.from_config(display.config), budget, display.budget)


class Bench:
    """Unopened driver with its emulated DAC."""

    def __init__(self, board=None, **device):
        self.clock = ManualClock()
        self.emulated = EmulatedHelios(self.clock, **device)
        self.device = self.emulated.device
        self.helios = Helios(board or build_config().board, self.clock, self.emulated)


def record_cold(display, kind, identity):
    """Record that a device's display is cold, as after a play long ago."""
    with HeatRecord(kind, build_uid(identity), display, ManualClock()) as record:
        record.save(display.build_cold_state()[1])
