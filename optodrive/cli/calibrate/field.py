"""`optodrive calibrate field`: fit a calibrated field to a file of measured spots."""

from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.calibrate.field_report import (
    FieldCalibration,
    FieldOutOption,
    ReportOption,
    check_calibration_outputs,
    write_calibration,
)
from optodrive.cli.options import ConfigOption, JsonOption


def field(
    spots: Annotated[Path, typer.Argument(metavar="SPOTS.csv", help="Measured spots: x_code,y_code,x_m,y_m.")],
    out: FieldOutOption = None,
    report: ReportOption = None,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Fit the field to a file of measured spots."""
    from optodrive.device.config_file import load_config
    from optodrive.lab.calibration.field_fit import fit_field
    from optodrive.lab.calibration.spot_checks import check_fit, check_spots
    from optodrive.lab.calibration.spots import FieldPrior, read_spots

    check_calibration_outputs(out, report)
    prior = FieldPrior.from_config(load_config(config))
    measured = read_spots(spots, prior.display)
    check_spots(str(spots), measured, prior)
    fit = fit_field(measured, prior)
    check_fit(str(spots), fit)
    write_calibration(FieldCalibration(fit, spots), out, report, json)
