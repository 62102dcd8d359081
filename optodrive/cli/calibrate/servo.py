"""`optodrive calibrate --mirrors`: measured steps of the mirrors to their servos."""

from importlib.util import find_spec
from pathlib import Path

from optodrive.cli.options import print_json
from optodrive.core.errors import InputError


def calibrate_servo(recording: Path, out: Path | None, config: str | None, json: bool) -> None:
    """Identify both servos, write mirrors.toml where asked, and say what was found and against what is configured."""
    if find_spec("scipy") is None:
        raise InputError("scipy", None, "the extra: pip install 'optodrive[analysis]'", "missing_extra")
    from optodrive.device.config import load_config
    from optodrive.lab.recording import read_recording
    from optodrive.lab.servo_identification.common_servo import find_common_servo
    from optodrive.lab.servo_identification.identify import identify
    from optodrive.lab.servo_identification.report import build_report, format_report_lines, write_mirrors
    from optodrive.lab.servo_identification.step_trace import extract_trace

    # What the configuration itself states, so that a file of mirrors that is no good keeps no one from a new one.
    loaded, source = load_config(config, measured_servo=False), str(recording)
    measurement = read_recording(recording)
    x_trace, y_trace = (extract_trace(source, measurement, axis) for axis in range(2))
    slew = loaded.scanner.slew_rad_per_s
    servos = identify(source, x_trace, slew), identify(source, y_trace, slew)
    stats = build_report(servos, find_common_servo(servos, loaded), loaded)
    if out is not None:
        write_mirrors(out, stats, source)
    if json:
        print_json(stats | ({} if out is None else {"mirrors": str(out)}))
        return
    for line in format_report_lines(stats):
        print(line)
    if out is not None:
        print(f"written          {out}")
