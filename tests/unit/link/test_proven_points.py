"""The door to the wire: bytes that exceed a cap do not pass it, wherever they come from."""

import zlib

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.link.board_setup import build_scales
from optodrive.link.protocol.quantisation import WirePoints
from optodrive.link.protocol.stage_points import StagePoints
from optodrive.link.proven_points import prove
from optodrive.planning.pipeline import plan_sequence

DISPLAY = DISPLAYS["display-16"]
SCALES = build_scales(DISPLAY.config)


@pytest.fixture(scope="module")
def planned():
    target_m = np.full(len(DISPLAY.pixels), 40e-6)
    sequence = FrameSequence((TactileFrame("f", 0.0, 1.0, target_m),))
    return plan_sequence(DISPLAY, sequence, *DISPLAY.build_cold_state())


def damage(points, position, factor):
    """Return the points with another gate-on time of one pulse, as of an encoder with a fault."""
    table = points.stages[0].table.copy()
    pulses = np.flatnonzero(table[:, 3])
    table[pulses[position], 3] *= factor
    return StagePoints((WirePoints(table, points.stages[0].row),))


def test_points_of_a_limited_plan_pass_with_the_checksum_of_their_bytes(planned):
    points, (_, budget) = StagePoints.from_plan(planned.plan, SCALES), DISPLAY.build_cold_state()
    proven = prove(planned.plan, points, SCALES, budget, DISPLAY.budget)
    assert proven.points is points
    assert proven.crc == zlib.crc32(points.encode_payload())
    assert len(proven.pulses.index) == len(planned.plan) == 16


@pytest.mark.parametrize("position", [0, 7, 15])
def test_a_pulse_that_the_encoder_made_longer_does_not_pass(planned, position):
    """The mutant proves the plan that was limited, and not the bytes."""
    points, (_, budget) = StagePoints.from_plan(planned.plan, SCALES), DISPLAY.build_cold_state()
    with pytest.raises(LocalProtocolError, match="passes a cap"):
        prove(planned.plan, damage(points, position, 25), SCALES, budget, DISPLAY.budget)


def test_rows_that_were_proven_before_count_by_the_state_alone(planned):
    """A cap that the first row passes is not applied to it again, and to each later row it is."""
    points, (_, budget) = StagePoints.from_plan(planned.plan, SCALES), DISPLAY.build_cold_state()
    damaged = damage(points, 0, 25)
    assert len(prove(planned.plan, damaged, SCALES, budget, DISPLAY.budget, first_row=1).pulses.index) == 15
    caps = DISPLAY.budget.caps._replace(absorber_k=1e-3)
    with pytest.raises(LocalProtocolError, match="absorber_temperature"):
        prove(planned.plan, points, SCALES, budget, replace_caps(caps), first_row=15)


def replace_caps(caps):
    return DISPLAY.budget._replace(caps=caps)
