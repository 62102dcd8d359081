"""`optodrive calibrate servo`: identify the galvo servos from a recording of mirror steps."""

from math import pi
from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import ConfigOption, JsonOption, StageOption
from optodrive.cli.output import list_written, print_answer
from optodrive.core.errors import MISSING, InputError
from optodrive.core.extras import import_extra


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
        _assess_responses(recording, sample_rate, out, json)
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


def _assess_responses(path: Path, sample_rate_hz: float | None, out: Path | None, json: bool) -> None:
    """Tell whether one linear servo suffices for periodic excitations of any axes in any unit."""
    from optodrive.lab.servo_identification.amplitude_response import (
        assess_coupled,
        build_records,
        describe_coupled,
        is_coupled,
        read_responses,
    )
    from optodrive.lab.servo_identification.effect_fit import find_effect
    from optodrive.lab.servo_identification.report import describe_linearity, report_linearity

    if sample_rate_hz is None:
        raise InputError("--sample-rate", MISSING, "samples per second of the .npz file")
    if out is not None:
        raise InputError(
            "--out", str(out), "a recording of both mirrors in rad: a plan cannot use responses in other units"
        )
    responses = read_responses(path, sample_rate_hz)
    if is_coupled(responses):
        report = assess_coupled(responses)
        lines = describe_coupled(report)
    else:
        found = [find_effect(*build_records(responses, axis)) for axis in range(responses.u.shape[1])]
        report = {"axes": [{"linearity": report_linearity(each)} for each in found]}
        lines = [
            f"axis {axis}           {line}"
            for axis, each in enumerate(report["axes"])
            for line in describe_linearity(each["linearity"])
        ]
    print_answer(report, lines, json)
