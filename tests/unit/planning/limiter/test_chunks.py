"""Plans are applied in chunks: the result is that of one pass, and progress is reported between them."""

from dataclasses import fields

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.plans import BudgetState
from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.protocol.quantisation import decode, quantise
from optodrive.planning.limiter import limiter
from optodrive.planning.limiter.limiter import commit_until, verify
from optodrive.planning.pipeline import plan_sequence

DISPLAY = DISPLAYS["display-16"]
SCALE = build_board_requirements(DISPLAY.config).scale


def build_plan():
    trains = tuple(PulseTrain(pixel, 0.01 * pixel, 0.9, 0.02, 0.03, 2.0) for pixel in range(3))
    heat, budget = DISPLAY.build_cold_state()
    return plan_sequence(DISPLAY, FrameSequence((), trains), heat, budget).plan, budget


@pytest.mark.parametrize("chunk", [1, 7, 10**6])
def test_chunks_do_not_change_the_state(monkeypatch, chunk):
    plan, budget = build_plan()
    whole = commit_until(plan, 10.0, budget, DISPLAY.budget)
    monkeypatch.setattr(limiter, "CHUNK_PULSES", chunk)
    calls = []
    chunked = commit_until(plan, 10.0, budget, DISPLAY.budget, lambda: calls.append(1))
    assert len(calls) == -(-len(plan) // chunk)
    for item in fields(BudgetState):
        np.testing.assert_array_equal(getattr(chunked, item.name), getattr(whole, item.name))


@pytest.mark.parametrize("chunk", [1, 7])
def test_a_pulse_above_a_cap_is_found_in_any_chunk(monkeypatch, chunk):
    monkeypatch.setattr(limiter, "CHUNK_PULSES", chunk)
    plan, budget = build_plan()
    points = quantise(plan, SCALE)
    decoded = decode(points.encode_payload(), SCALE)
    calls = []
    verify(plan, points.row[decoded.index], decoded, budget, DISPLAY.budget, lambda: calls.append(1))
    assert calls
    hot = decoded.power_w.copy()
    hot[-1] *= 1000.0
    object.__setattr__(decoded, "power_w", hot)
    with pytest.raises(LocalProtocolError, match=f"encoded pulse {len(hot) - 1} "):
        verify(plan, points.row[decoded.index], decoded, budget, DISPLAY.budget)
