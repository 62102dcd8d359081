"""Columns of pulses."""

import json

import numpy as np

from optodrive.planning.summary_schema import PulseColumns


def test_columns_keep_their_types_in_json():
    column = np.array([0.5, 1.0]).tolist()
    columns = PulseColumns(
        start_s=column,
        width_s=column,
        power_w=column,
        pixel=[1, 2],
        stage=[0, 1],
        energy_j=column,
        trimmed_j=column,
        reason=["", "pulse_energy"],
        target_um=[None, 5.0],
        predicted_um=column,
    )
    assert PulseColumns.model_validate_json(columns.model_dump_json()) == columns
    assert json.loads(columns.model_dump_json())["pixel"] == [1, 2]
