"""`optodrive calibrate servo`: identify the galvo servos from a recording of mirror steps."""

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import ConfigOption, JsonOption, StageOption
from optodrive.cli.output import print_json
from optodrive.core.errors import MISSING, InputError


def servo(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="Recording of steps of both mirrors.")],
    out: Annotated[Path | None, typer.Option("--out", metavar="mirrors.toml", help="Write the servos.")] = None,
    config: ConfigOption = None,
    stage: StageOption = None,
    json: JsonOption = False,
) -> None:
    """Identify both mirror servos from a recording of steps, and compare them with the configuration."""
    if find_spec("scipy") is None:
        raise InputError("scipy", MISSING, "the extra: pip install 'optodrive[analysis]'", "missing_extra")
    from optodrive.core.files import check_output
    from optodrive.device.config_file import load_config
    from optodrive.lab.diagnosis.plausible_units import check_recording_units
    from optodrive.lab.recording import read_recording
    from optodrive.lab.servo_identification.common_servo import find_common_servo
    from optodrive.lab.servo_identification.identify import identify
    from optodrive.lab.servo_identification.report import build_report, format_report_lines, write_mirrors
    from optodrive.lab.servo_identification.step_trace import extract_trace
    from optodrive.physics.parameters import load_parameters

    check_output("--out", out, ".toml")
    # Servos measured before are not loaded: an invalid mirrors.toml must not prevent a new identification.
    loaded, source = load_config(config, measured_servo=False).select_stage(stage), str(recording)
    measurement = read_recording(recording)
    reference = load_parameters(loaded.pixel_model.parameters).build_pixel(loaded.display.bridge_width_m)
    check_recording_units(measurement, reference, source)
    x_trace, y_trace = (extract_trace(source, measurement, axis) for axis in range(2))
    slew_rad_per_s = loaded.scanner.slew_rad_per_s
    servos = identify(source, x_trace, slew_rad_per_s), identify(source, y_trace, slew_rad_per_s)
    report = build_report(servos, find_common_servo(servos, loaded), loaded)
    if out is not None:
        write_mirrors(out, report, source)
    if json:
        print_json(report | ({} if out is None else {"mirrors": str(out)}))
        return
    for line in format_report_lines(report):
        print(line)
    if out is not None:
        print(f"written          {out}")
