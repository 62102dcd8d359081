"""Black-box conformance with PROTOCOL.md in virtual time: each scenario against each board core.

The emulated chip plays in every run what the processes on ptys play; scripts/test --slow plays all.
"""

import edge_scenarios
import link_scenarios
import pytest
import trust_scenarios
from all_scenarios import MODULES, SCENARIOS
from bench import BRIGHT, Bench, set_input
from process_board import has_subject
from scenario import GUARDS, audit_output, judge
from test_conformance_pty import in_every_run, list_cases, name_case

OF_A_PORT = (link_scenarios.__name__, trust_scenarios.__name__, edge_scenarios.__name__)
"""Modules whose scenarios a port can change; the other guards see only what it has carried."""


def list_of_a_port():
    """Return the scenarios that a port can change."""
    return [case for case in SCENARIOS if in_every_run(case) or case.module in OF_A_PORT]


@pytest.mark.parametrize("case", list_cases("interrupted"), ids=name_case)
def test_a_core_with_ticks_wherever_they_may_interrupt_conforms(case, virtual):
    judge(virtual("interrupted"), case)


@pytest.mark.slow
@pytest.mark.parametrize("case", list_cases("pico"), ids=name_case)
def test_emulated_pico_conforms(case, virtual):
    judge(virtual("pico"), case)


@pytest.mark.slow
@pytest.mark.parametrize("case", list_cases("pico-xy2"), ids=name_case)
def test_emulated_pico_with_a_digital_head_conforms(case, virtual):
    judge(virtual("pico-xy2"), case)


@pytest.mark.slow
@pytest.mark.parametrize("case", list_of_a_port(), ids=name_case)
def test_emulated_pico_conforms_on_its_usb_port(case, virtual):
    judge(virtual("pico-usb"), case)


@pytest.mark.parametrize("case", list_cases("qemu"), ids=name_case)
def test_emulated_chip_conforms(case, virtual):
    judge(virtual("qemu"), case)


@pytest.mark.parametrize(
    ("case", "name"),
    [
        pytest.param(case, name, id=f"{name_case(case)}-{name}")
        for case in SCENARIOS
        for name in ("python", "c")
        if has_subject(name, case.subject)
    ],
)
def test_conforms(case, name, virtual):
    judge(virtual(name), case)


@pytest.mark.parametrize(("reason", "late_us"), [("abort", 1), ("fault", 101)])
def test_an_output_later_than_its_log_is_detected(virtual, tmp_path, reason, late_us):
    bench = Bench(virtual("c"), tmp_path)
    host = bench.ready(set_input("interlock", False), **BRIGHT)
    host.shine()
    if reason == "abort":
        host.send("ABORT")
    else:
        host.board.next_step()
    host.wait_for_change(reason)
    logged, edges = host.board.of("gate"), host.board.output_edges()
    assert logged[-1]["reason"] == reason
    audit_output(logged, edges)
    late = (logged[-1]["t_us"] + late_us, False)
    with pytest.raises(AssertionError, match="output at"):
        audit_output(logged, [*edges[:-1], late])


def test_every_module_and_every_guard_is_looked_at():
    assert {case.module for case in SCENARIOS} == set(MODULES)
    assert {case.subject for case in SCENARIOS} > set(GUARDS)


@pytest.mark.parametrize("name", ["python", "c"])
def test_a_scenario_runs_equally_each_time(name, virtual, tmp_path):
    (case,) = [case for case in SCENARIOS if case.name == "invalid_frames_change_only_counters"]
    logs = []
    for _ in range(2):
        bench = Bench(virtual(name), tmp_path)
        case.play(bench)
        bench.finish(lambda board: logs.append(board.events()))
    assert logs[0] == logs[1]
