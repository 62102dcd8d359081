"""`optodrive calibrate --mirrors`: measured steps of the mirrors to their servos."""

from importlib.util import find_spec
from pathlib import Path

from optodrive.cli.options import print_json
from optodrive.core.errors import InputError


def calibrated_mirrors(recording: Path, out: Path | None, config: str | None, json: bool) -> None:
    """Identify both servos, write mirrors.toml where asked, and say what was found and against what is configured."""
    if find_spec("scipy") is None:
        raise InputError("scipy", None, "the extra: pip install 'optodrive[analysis]'", "missing_extra")
    from optodrive.device.config import load_config
    from optodrive.lab.recording import read_recording
    from optodrive.lab.servo_identification.common_servo import common_servo
    from optodrive.lab.servo_identification.identify import identify
    from optodrive.lab.servo_identification.report import figures, lines, write_mirrors
    from optodrive.lab.servo_identification.step_trace import trace_of

    # What the configuration itself states, so that a file of mirrors that is no good keeps no one from a new one.
    loaded, where = load_config(config, measured=False), str(recording)
    measurement = read_recording(recording)
    x_trace, y_trace = (trace_of(where, measurement, axis) for axis in range(2))
    slew = loaded.scanner.slew_rad_per_s
    mirrors = identify(where, x_trace, slew), identify(where, y_trace, slew)
    told = figures(mirrors, common_servo(mirrors, loaded), loaded)
    if out is not None:
        write_mirrors(out, told, where)
    if json:
        print_json(told | ({} if out is None else {"mirrors": str(out)}))
        return
    for line in lines(told):
        print(line)
    if out is not None:
        print(f"written          {out}")
