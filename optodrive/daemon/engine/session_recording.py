"""Recording of the plans of a session to HDF5."""

import json
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from optodrive import __version__
from optodrive.core.types.stimuli import HeightTrain, PulseTrain
from optodrive.daemon.engine.active_plan import ActivePlan, compute_simulated_m
from optodrive.daemon.engine.engine import Engine
from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.log import DaemonLog
from optodrive.lab.recording.session import SessionRecorder
from optodrive.link.session.clock_sync import ClockReading
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.effective_config import build_effective_config
from optodrive.planning.stimuli.train_json import train_to_json

PlanEntry = tuple[dict[str, Any], dict[str, np.ndarray[Any, Any]]]


def build_session_path(folder: Path) -> Path:
    """Return a file name with the present UTC time in a folder."""
    return folder / f"session-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.h5"


def describe_display(display: DisplayModel) -> dict[str, Any]:
    """Return the attributes of the session."""
    return {
        "display": display.config.name,
        "optodrive": __version__,
        "ambient_K": display.ambient_k,
        "bridge_width_m": display.config.display.bridge_width_m,
        "config": build_effective_config(display).model_dump_json(),
    }


def build_plan_entry(active: ActivePlan, tick_s: float, board_now_s: float, clocks: ClockReading | None) -> PlanEntry:
    """Return the entry of an ended plan: request, plan, execution on the board's clock, and simulated heights.

    clocks: a moment on all clocks, for a plan without an onset; None while they are not synchronised
    """
    record, planned, plan = active.record, active.planned, active.planned.plan
    frames = planned.sequence.frames
    trains = [train_to_json(train) for train in planned.sequence.trains]
    attributes: dict[str, Any] = {
        "plan": record.plan_id,
        "name": record.name,
        "status": record.status,
        "error": record.error,
        "start_s": record.start_s,
        "summary": record.summary_json.decode(),
        "trains": json.dumps(trains),
        "labels": json.dumps(record.labels, ensure_ascii=False),
        "parameters": json.dumps(record.parameters, ensure_ascii=False),
    }
    attributes |= _describe_onsets(record, [f.show_at_s for f in frames], planned.sequence.trains, clocks)
    arrays = {
        "requested_frames": np.array([(f.show_at_s, f.duration_s, f.simultaneous, f.priority) for f in frames]).reshape(
            -1, 4
        ),
        "target_um": 1e6 * np.array([frame.target_m for frame in frames]),
        "planned": np.column_stack([plan.start_s, plan.width_s, plan.power_w, plan.pixel, plan.trimmed_j]),
        "predicted_m": planned.predicted_m,
    }
    executed = active.executed
    if executed is not None and len(executed):
        on_s = executed.on_tick * tick_s
        unix_s = time.time() - (board_now_s - float(on_s[0]))
        attributes |= {"first_pulse_unix_s": unix_s, "first_pulse_at": datetime.fromtimestamp(unix_s, UTC).isoformat()}
        arrays["executed"] = np.column_stack([on_s, executed.width_s, executed.power_w, executed.pixel])
        heights_m = active.simulated_m if active.simulated_m is not None else compute_simulated_m(active)
        if heights_m is not None:
            arrays["simulated_m"] = heights_m
    return attributes, arrays


def _describe_onsets(
    record: PlanRecord, show_at_s: list[float], trains: Sequence[PulseTrain | HeightTrain], clocks: ClockReading | None
) -> dict[str, float]:
    """Return requested and executed onset on the clocks of board and host, as far as they are known."""
    out: dict[str, float] = {}
    times_s = [*show_at_s, *(train.start_s for train in trains)]
    if times_s:
        requested_s, reading = record.start_s - record.folded_delay_s + min(times_s), record.onset or clocks
        known = {"board_s": requested_s} if reading is None else reading.convert(requested_s)._asdict()
        out |= {f"requested_{name}": value for name, value in known.items()}
    if record.onset is not None:
        out |= {f"executed_{name}": value for name, value in record.onset._asdict().items()}
    return out


def start_session_recorder(engine: Engine, path: Path | None, log: DaemonLog) -> SessionRecorder | None:
    """Start to record every plan that ends. Return None if neither `path` nor the configuration requests it."""
    folder = engine.display.config.daemon.record
    if path is None and not folder:
        return None
    path = build_session_path(Path(folder)) if path is None else path
    recorder = SessionRecorder(path, describe_display(engine.display), log.warn)

    def record_plan(plan: ActivePlan) -> None:
        recorder.record(lambda: build_plan_entry(plan, engine.scales[0].tick_s, engine.board_s(), engine.read_clocks()))

    engine.add_plan_end_callback(record_plan)
    return recorder
