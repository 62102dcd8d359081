"""`optodrive calibrate servo`: identify the galvo servos from a recording of mirror steps."""

from math import pi
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.options import ConfigOption, JsonOption, StageOption
from optodrive.cli.output import list_written, print_answer, print_json
from optodrive.core.errors import MISSING, InputError
from optodrive.core.extras import import_extra

if TYPE_CHECKING:
    from optodrive.device.config import Config

if TYPE_CHECKING:
    from optodrive.core.types.arrays import FloatArray
    from optodrive.core.types.measurements import Signal
    from optodrive.device.config import Config
    from optodrive.lab.commissioning.mirror_steps import StepRun
    from optodrive.planning.display_model import DisplayModel


PAUSE_MAX_S = 60.0
LAST_STEP_S = 0.015
"""Time for which the last step is recorded."""
NOTES = "Steps of optodrive calibrate steps. Add mirror_x_rad.csv and mirror_y_rad.csv to each run."


def steps(
    out: Annotated[Path, typer.Option("--out", metavar="FOLDER", help="Write the commands: a recording to complete.")],
    step_count: Annotated[int, typer.Option("--steps", help="Steps of mirror x per run; y has half as many.")] = 24,
    pause_s: Annotated[
        float, typer.Option("--pause", metavar="SECONDS", help="Pause between runs, in which a scope rearms.")
    ] = 2.0,
    config: ConfigOption = None,
    stage: StageOption = None,
    json: JsonOption = False,
) -> None:
    """Play steps of both mirrors, three sizes twice, with the gate off, for a recording of their position outputs."""
    from optodrive.cli.commissioning import open_board
    from optodrive.core.files import check_output
    from optodrive.lab.commissioning.mirror_steps import LEAD_IN_S, plan_step_runs, play_step_runs

    check_output("--out", out, folder=True)
    if not 0.0 <= pause_s <= PAUSE_MAX_S:
        raise InputError("--pause", pause_s, f"0 to {PAUSE_MAX_S:g} s")
    played: list[tuple[StepRun, FloatArray]] = []

    def report_run(run: "StepRun", commands: "FloatArray") -> None:
        played.append((run, commands))
        if not json:
            x_rad, y_rad = commands[1, 1:] - commands[0, 1:]
            size = f"{x_rad:.4f} rad in x and {y_rad:.4f} rad in y"
            print(f"{run.name:<17}{len(commands) - 1} steps of {size}, {commands[-1, 0]:.2f} s", flush=True)

    with open_board(config, stage=stage) as (board, _):
        runs = plan_step_runs(board, step_count)
        board.connect()
        board.arm()
        play_step_runs(runs, board, pause_s, report_run)
        board.disarm()
        display = board.display
    is_simulated = display.config.board.transport == "simulated"
    _write_commands(out, played, display, is_simulated)
    if json:
        print_json({"recording": str(out), "trigger_s": LEAD_IN_S, "runs": [run.name for run, _ in played]})
        return
    print(f"written          {out}; the first step of a run is at {LEAD_IN_S:g} s of its time")
    if is_simulated:
        print("simulated        with what a scope would measure on mirrors with the configured servo, to rehearse")
        print(f"next             optodrive calibrate servo {out}")


def _write_commands(
    out: Path, played: "list[tuple[StepRun, FloatArray]]", display: "DisplayModel", is_simulated: bool
) -> None:
    """Write the commands of each run, with the traces of a scope for a simulated board."""
    import numpy as np

    from optodrive.core.types.measurements import Measurement, Run
    from optodrive.lab.recording import write_recording

    runs = []
    for seed, (run, commands) in enumerate(played):
        signals = _measure(display.config, commands, seed) if is_simulated else {}
        runs.append(Run(run.name, display.ambient_k, np.zeros((0, 4)), signals, {}, commands))
    write_recording(out, Measurement(tuple(runs)), "" if is_simulated else NOTES)


def _measure(config: "Config", commands: "FloatArray", seed: int) -> "dict[str, Signal]":
    from optodrive.core.types.measurements import Signal
    from optodrive.link.simulator.galvos import measure_position_outputs

    t_s, x_rad, y_rad = measure_position_outputs(config, commands, float(commands[-1, 0]) + LAST_STEP_S, seed).T.copy()
    return {"mirror_x_rad": Signal(0, t_s, x_rad), "mirror_y_rad": Signal(0, t_s, y_rad)}


def servo(
    recording: Annotated[
        Path, typer.Argument(metavar="RECORDING", help="Recording of both mirrors, or .npz of any axes.")
    ],
    out: Annotated[Path | None, typer.Option("--out", metavar="mirrors.toml", help="Write the servos.")] = None,
    config: ConfigOption = None,
    stage: StageOption = None,
    sample_rate: Annotated[
        float | None,
        typer.Option("--sample-rate", metavar="HZ", min=1.0, help="Of an .npz file of periodic excitations."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Identify both mirror servos from steps or any excitation, and tell whether one linear servo suffices."""
    import_extra("scipy")
    from optodrive.core.files import check_output
    from optodrive.device.config_file import load_config
    from optodrive.lab.diagnosis.recording_checks import check_recording_units
    from optodrive.lab.recording import read_recording
    from optodrive.lab.servo_identification.effect_fit import find_effect
    from optodrive.lab.servo_identification.gate import assess, find_common_servo
    from optodrive.lab.servo_identification.identify import identify, identify_excitation
    from optodrive.lab.servo_identification.records import extract_records, extract_trace, is_excitation
    from optodrive.lab.servo_identification.report import build_report, format_report_lines, write_mirrors
    from optodrive.physics.parameters import load_parameters

    if recording.suffix == ".npz":
        _assess_responses(
            recording, sample_rate, out, load_config(config, measured_servo=False).select_stage(stage), json
        )
        return
    check_output("--out", out, ".toml")
    # Servos measured before are not loaded: an invalid mirrors.toml must not prevent a new identification.
    loaded, source = load_config(config, measured_servo=False).select_stage(stage), str(recording)
    measurement = read_recording(recording)
    reference = load_parameters(loaded.pixel_model.parameters).build_pixel(loaded.display.bridge_width_m)
    check_recording_units(measurement, reference, source)
    slew_rad_per_s, servos, effects = loaded.scanner.slew_rad_per_s, [], []
    for axis in range(2):
        records = extract_records(source, measurement, axis)
        if is_excitation(measurement, axis):
            found = find_effect(records, 2.0 * pi * loaded.scanner.bandwidth_hz)
            servos.append(identify_excitation(source, records, axis, found, slew_rad_per_s))
        else:
            servos.append(identify(source, extract_trace(source, measurement, axis), slew_rad_per_s))
            identified = servos[-1].servo
            found = find_effect(records, 2.0 * pi * identified.frequency, identified)
        effects.append(assess(found, servos[-1].residual_rad, loaded, axis))
    mirrors, mirror_effects = (servos[0], servos[1]), (effects[0], effects[1])
    common = find_common_servo(mirrors, loaded, lambda axis, move, tolerance: effects[axis].settling_s(move, tolerance))
    report = build_report(mirrors, common, loaded, mirror_effects)
    if out is not None:
        write_mirrors(out, report, source)
    document = report | ({} if out is None else {"mirrors": str(out)})
    print_answer(document, [*format_report_lines(report), *list_written(out)], json)


def _assess_responses(path: Path, sample_rate_hz: float | None, out: Path | None, config: "Config", json: bool) -> None:
    """Tell whether one linear servo suffices for periodic excitations of any axes in any unit."""
    import numpy as np

    from optodrive.lab.servo_identification.amplitude_response import assess_coupled, describe_coupled
    from optodrive.lab.servo_identification.effect_fit import find_effect
    from optodrive.lab.servo_identification.gate import bound_coupled_moves
    from optodrive.lab.servo_identification.periodic_responses import build_records, is_coupled, read_responses
    from optodrive.lab.servo_identification.report import (
        describe_linearity,
        report_linearity,
        scanner_table,
        write_mirrors,
    )

    if sample_rate_hz is None:
        raise InputError("--sample-rate", MISSING, "samples per second of the .npz file")
    responses = read_responses(path, sample_rate_hz)
    if out is not None and responses.angle_per_output is None:
        raise InputError(
            f"{path}: angle_per_output", MISSING, "rad of mirrors x and y per unit of each output, for --out"
        )
    if out is not None or is_coupled(responses):
        axes = assess_coupled(responses)
        report, lines = axes.report, describe_coupled(axes.report)
        if out is not None:
            servo, error_rad = bound_coupled_moves(axes, np.asarray(responses.angle_per_output), config)
            name = axes.law if axes.report["verdict"] == "cause" else axes.report["verdict"]
            effect = {"name": [name] * 2, "error_rad": list(error_rad)}
            mirrors = {"scanner": scanner_table(servo), "galvo": {"share": 1.0}, "effect": effect, "axes": {}}
            write_mirrors(out, mirrors, str(path))
            report = report | {"scanner": mirrors["scanner"], "effect": effect, "mirrors": str(out)}
            lines.append(f"error that stays {error_rad[0]:.3g} rad of x and {error_rad[1]:.3g} rad of y")
    else:
        found = [find_effect(*build_records(responses, axis)) for axis in range(responses.u.shape[1])]
        report = {"axes": [{"linearity": report_linearity(each)} for each in found]}
        lines = [
            f"axis {axis}           {line}"
            for axis, each in enumerate(report["axes"])
            for line in describe_linearity(each["linearity"])
        ]
    print_answer(report, [*lines, *list_written(out)], json)
