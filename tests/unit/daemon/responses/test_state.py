"""The state report of an engine that was never started, and columns of pulses."""

import json

import numpy as np

from optodrive.core.clock import MonotonicClock
from optodrive.daemon.one_process.engine import Engine
from optodrive.daemon.responses.state import StateReport
from optodrive.device.config_file import load_config
from optodrive.link.transport.simulated import SimulatedBoard
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.summary_schema import PulseColumns


def test_every_part_of_the_engine_reports_the_members_that_the_model_states():
    engine = Engine(
        DisplayModel.from_config(load_config("display-16")), SimulatedBoard("", 1_000_000), MonotonicClock()
    )
    state = engine.snapshot()
    engine.close()
    assert StateReport.model_validate_json(state.model_dump_json()) == state
    assert (state.link.state, state.board.state, state.queue.plans) == ("down", "UNKNOWN", [])
    assert not state.board.is_armed


def test_columns_keep_their_types_in_json():
    column = np.array([0.5, 1.0]).tolist()
    columns = PulseColumns(
        start_s=column,
        width_s=column,
        power_w=column,
        pixel=[1, 2],
        energy_j=column,
        trimmed_j=column,
        reason=["", "pulse_energy"],
        target_um=[None, 5.0],
        predicted_um=column,
    )
    assert PulseColumns.model_validate_json(columns.model_dump_json()) == columns
    assert json.loads(columns.model_dump_json())["pixel"] == [1, 2]
