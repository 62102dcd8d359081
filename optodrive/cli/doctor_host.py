"""Checks of the computer: Python, packages, clock, processor, disk, compiled kernels, and the measured servo."""

import re
import shutil
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path

from optodrive.cli.output import Finding, report_ok, report_problem, report_warning
from optodrive.core.clock import Clock
from optodrive.core.errors import InputError
from optodrive.core.quantity import format_quantity
from optodrive.device.config import Config
from optodrive.device.field_loader import build_settling_table
from optodrive.link.transport.port_state import ROOT, join_root

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


MIN_PYTHON = (3, 11)
SLEEP_S = 0.001
OBSERVATION_S = 1.0
OVERSHOOT_WARNING_S = 0.01
CLOCK_RESOLUTION_MAX_S = 1e-4
DISK_LOW_BYTES = 1_000_000_000
DISK_FULL_BYTES = 50_000_000


def check_python() -> Finding:
    """Check the version of Python."""
    observation = sys.version.split()[0]
    if sys.version_info < MIN_PYTHON:
        return report_problem("python", observation, "use Python 3.11 or newer")
    return report_ok("python", observation)


def check_packages(name: str = "optodrive") -> list[Finding]:
    """Check the installed packages against the metadata of `name`."""
    try:
        requirements = [text for text in metadata.requires(name) or [] if "extra ==" not in text]
    except metadata.PackageNotFoundError:
        return [
            report_warning(
                "packages", f"{name} is not installed, it runs from its sources", "install it: pip install ."
            )
        ]
    violations = [violation for text in requirements if (violation := _check_requirement(text))]
    if violations:
        return [report_problem("packages", text, "install the package again: pip install .") for text in violations]
    return [report_ok("packages", f"all {len(requirements)} installed")]


def _check_requirement(requirement: str) -> str | None:
    match = re.match(r"([\w.-]+)(?:\[[^]]*])?\s*(?:>=\s*([\d.]+))?", requirement)
    if match is None:
        return None
    name, min_version = match.groups()
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return f"{name} is missing"
    if min_version is not None and _parse_version(version) < _parse_version(min_version):
        return f"{name} {version} is older than {min_version}"
    return None


def _parse_version(version: str) -> list[int]:
    return [int(part) for part in re.findall(r"\d+", version)[:3]]


def check_clock(clock: Clock, lease_s: float) -> Finding:
    """Check the resolution of the monotonic clock, and the overshoot of 1 ms sleeps over one second."""
    resolution_s = time.get_clock_info("monotonic").resolution
    overshoot_s, end_s = 0.0, clock.now_s() + OBSERVATION_S
    while (before_s := clock.now_s()) < end_s:
        clock.sleep(SLEEP_S)
        overshoot_s = max(overshoot_s, clock.now_s() - before_s - SLEEP_S)
    resolution = format_quantity(resolution_s, "s")
    observation = f"resolution {resolution}; a 1 ms sleep overshot by max {overshoot_s * 1e3:.2f} ms"
    if resolution_s > CLOCK_RESOLUTION_MAX_S:
        return report_problem(
            "clock", observation, "the monotonic clock is too coarse: select another clock source in the kernel"
        )
    if overshoot_s > lease_s / 2:
        return report_problem(
            "clock",
            observation,
            f"more than half the lease of {format_quantity(lease_s, 's')}: end other programs on this computer",
        )
    if overshoot_s > OVERSHOOT_WARNING_S:
        return report_warning(
            "clock",
            observation,
            "the computer is busy or saves power: end other programs, or select the performance governor",
        )
    return report_ok("clock", observation)


def check_governor(root: Path = ROOT) -> Finding:
    """Check the frequency governor of the processor."""
    folders = join_root(root, "/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq")
    governors = {_read_word(folder / "scaling_governor") for folder in folders} - {""}
    if not governors:
        return report_ok("processor", "this system does not control its frequency")
    observation = "governor " + ", ".join(sorted(governors))
    if governors == {"performance"}:
        return report_ok("processor", observation)
    if "powersave" in governors:
        return report_warning(
            "processor", observation, "causes late wake-ups: sudo cpupower frequency-set -g performance"
        )
    return report_ok("processor", observation)


def _read_word(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""


def check_disk() -> list[Finding]:
    """Check the free space of the working folder and of the folder for temporary files (the simulated board's log)."""
    folders = dict.fromkeys((Path.cwd(), Path(tempfile.gettempdir())))
    return [check_free_space(folder, shutil.disk_usage(folder).free) for folder in folders]


def check_free_space(folder: Path, free_bytes: int) -> Finding:
    """Check the space for logs and link captures. One hour at 100 pulses/s is a capture of about 30 MB."""
    observation = f"{free_bytes / 1e9:.1f} GB free in {folder}"
    if free_bytes < DISK_FULL_BYTES:
        return report_problem("disk", observation, "free space: logs and recordings stop when the disk is full")
    if free_bytes < DISK_LOW_BYTES:
        return report_warning("disk", observation, "free space, or record to another disk")
    return report_ok("disk", observation)


def check_kernels() -> Finding:
    """Check whether compiled kernels are cached."""
    from optodrive.core.kernels import CACHED, is_cached
    from optodrive.planning.limiter.pulse_application import apply_pulses

    if not CACHED:
        return report_warning(
            "kernels", "compiled kernels cannot be cached", "make ~/.cache/optodrive writable, or set NUMBA_CACHE_DIR"
        )
    if not is_cached(apply_pulses):  # the last kernel that a plan compiles
        return report_warning(
            "kernels", "not compiled yet", "the first start takes half a minute: run `optodrive serve` once"
        )
    return report_ok("kernels", "compiled")
