import pytest

from displays import DISPLAYS
from optodrive.daemon.api.state_merge import NO_PLANNER, NO_STATS, merge_state
from optodrive.daemon.responses.state import PlannerState, StateReport
from optodrive.link.service.status import ServiceStatus
from optodrive.link.session.board_view import BoardView
from stage_rig import build_stages

STATUS = {
    "connected": True,
    "port": "/dev/ttyACM0",
    "link_error": None,
    "stats": {**NO_STATS, "naks": 3},
    "board": BoardView(state="RUNNING", uid="b1").to_dict(),
    "stages": [],
    "pause": {"number": 1, "began_s": 2.0, "ends_in_s": None},
    "control": {"caller": "ann", "armed_for_s": 3.0, "hold": True, "arming": 7},
}


def merge(status=STATUS, planner=NO_PLANNER, config=DISPLAYS["display-16"].config):
    known = None if status is None else ServiceStatus.from_fields(status)
    state = merge_state(config, 16, known, planner)
    assert StateReport.model_validate_json(state.model_dump_json()) == state
    return state


def test_the_parts_of_both_processes_are_reported():
    planner = PlannerState.model_validate({**NO_PLANNER.model_dump(), "planner": {"busy": True, "alive": True}})
    state = merge(planner=planner)
    assert (state.board.state, state.board.uid, state.link.naks, state.link.state) == ("RUNNING", "b1", 3, "up")
    assert state.planner.busy
    assert (state.control.caller, state.control.armed_for_s, state.control.hold) == ("ann", 3.0, True)


def test_a_board_without_a_link_has_no_known_state():
    fault = BoardView(state="FAULT", fault="LINK").to_dict()
    state = merge({**STATUS, "connected": False, "link_error": "the cable is out", "board": fault})
    assert (state.board.state, state.board.fault, state.board.hint) == ("UNKNOWN", None, "")
    assert (state.link.state, state.link.error) == ("down", "the cable is out")
    assert state.control is None


@pytest.mark.parametrize(
    ("silence_s", "state"), [(0.0, "RUNNING"), (0.5, "RUNNING"), (0.51, "UNKNOWN"), (9.0, "UNKNOWN")]
)
def test_a_board_that_is_silent_has_no_known_state(silence_s, state):
    merged = merge({**STATUS, "stats": {**NO_STATS, "silence_s": silence_s}})
    assert (merged.board.state, merged.link.state, merged.link.silence_s) == (state, "up", silence_s)


def test_every_stage_is_listed_without_a_link_process_or_a_link():
    config = build_stages("display-16", 2).config
    unknown = merge(None, config=config).stages
    assert [(stage.name, stage.connected, stage.board.state) for stage in unknown] == [
        ("s0", False, "UNKNOWN"),
        ("s1", False, "UNKNOWN"),
    ]
    assert "link process does not run" in unknown[0].error
    left = unknown[1].model_dump() | {"connected": True, "error": None, "board": BoardView(state="DISARMED").to_dict()}
    status = {**STATUS, "connected": False, "link_error": "stage 's0': unplugged"}
    status["stages"] = [unknown[0].model_dump(), left]
    assert [stage.board.state for stage in merge(status, config=config).stages] == ["UNKNOWN", "DISARMED"]


@pytest.mark.parametrize(("status", "planner"), [(None, NO_PLANNER), (STATUS, None), (None, None)])
def test_a_process_that_does_not_run_is_reported(status, planner):
    state = merge(status, planner)
    assert state.planner.alive is False
    if status is None:
        assert (state.board.state, state.link.state) == ("UNKNOWN", "down")
        assert "link process does not run" in state.link.error


@pytest.mark.parametrize("ends_in_s", [None, 120.0])
def test_a_pause_is_reported_before_the_planner_knows_of_it(ends_in_s):
    plan = {"plan": "p1", "name": "push", "caller": "ann", "planned": 9, "executed": 3, "error": None, "age_s": 1.0}
    plan |= {"duration_s": 2.0, "starts_in_s": -1.0, "ends_in_s": 1.0}
    active = [plan | {"status": "running"}, plan | {"status": "queued"}]
    queue = {**NO_PLANNER.queue.model_dump(), "active": active, "running": "p1", "paused": ends_in_s is None}
    planner = PlannerState.model_validate({**NO_PLANNER.model_dump(), "queue": queue})
    state = merge({**STATUS, "pause": {**STATUS["pause"], "ends_in_s": ends_in_s}}, planner)
    assert (state.queue.paused, state.queue.pause_ends_in_s) == (ends_in_s is not None, ends_in_s)
    running, waiting = state.queue.active
    assert (running.status, running.ends_in_s) == (("running", 1.0) if ends_in_s is None else ("paused", None))
    assert (waiting.status, waiting.ends_in_s) == ("queued", 1.0)
    assert merge(None, planner).queue.paused is False


@pytest.mark.parametrize(("transport", "words"), [("helios", "After the death"), ("idn", "After STOP or the death")])
def test_a_laser_dac_states_what_it_cannot_promise(transport, words):
    config = DISPLAYS["display-16"].config
    assert merge_state(config, 16, None, None).link.limitation is None
    board = config.board.model_copy(update={"transport": transport, "port": "dac"})
    limitation = merge_state(config.model_copy(update={"board": board}), 16, None, None).link.limitation
    assert limitation.startswith("Laser DAC: no interlock, key or emergency stop of its own")
    assert words in limitation
