"""Check of the mirrors: whether their servo was measured, and how long their moves keep the laser dark."""

from pathlib import Path

from optodrive.cli.doctor_finding import Finding, report_ok, report_problem, report_warning
from optodrive.core.errors import InputError
from optodrive.core.quantity import format_quantity
from optodrive.device.config import Config
from optodrive.device.field_loader import build_settling_table

MEASURED = 0.02
"""Smallest relative half-width that `optodrive calibrate servo` states."""


def check_mirrors(config: Config) -> Finding:
    """Check whether the servo was measured: the gate opens when every servo that it may be has settled."""
    try:
        dark_s = _compute_dark_s(config)
    except InputError as error:
        return report_problem("mirrors", str(error), "correct it; `optodrive config check` checks it again")
    scanner = config.scanner
    servo = f"{format_quantity(scanner.bandwidth_hz, 'Hz')} ± {100 * scanner.bandwidth_uncertainty:.3g} %"
    dark = f"{format_quantity(dark_s, 's')} dark from pixel to pixel"
    if scanner.mirrors is not None:
        return report_ok("mirrors", f"servo of {Path(scanner.mirrors).name}: {servo}, {dark}")
    if config.board.transport == "simulated":
        return report_ok("mirrors", f"simulated servo: {servo}, {dark}")
    half_widths = dict.fromkeys(("bandwidth_uncertainty", "damping_uncertainty", "slew_uncertainty"), MEASURED)
    measured = config.model_copy(update={"scanner": scanner.model_copy(update=half_widths)})
    return report_warning(
        "mirrors",
        f"servo stated, not measured: {servo}, {dark}",
        f"light of another servo leaves the absorber; `optodrive calibrate servo` measures it, which may shorten the "
        f"dark to {format_quantity(_compute_dark_s(measured), 's')}",
    )


def _compute_dark_s(config: Config) -> float:
    """Return the time of a move over one pitch after a long pulse, s."""
    table = build_settling_table(config)
    return 1e-6 * (max(axis_us[1] for axis_us in table.after_long_dwell) - table.early_us)
