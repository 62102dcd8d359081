"""The command group `optodrive calibrate field | camera | board | steps | servo | sweep | pixels | power | film`."""

import typer

from optodrive.cli.calibrate.board import board
from optodrive.cli.calibrate.field import camera, field
from optodrive.cli.calibrate.film import film
from optodrive.cli.calibrate.pixels import pixels, sweep
from optodrive.cli.calibrate.power import power
from optodrive.cli.calibrate.servo import servo, steps

GROUP = typer.Typer(
    help="Calibrate the scan field, the servos, the pixels, the laser's power or a film.", no_args_is_help=True
)
for command in (field, camera, board, steps, servo, sweep, pixels, power, film):
    GROUP.command()(command)
