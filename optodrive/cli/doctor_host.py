"""What the doctor looks at on the computer itself: Python, packages, clock, processor, disk, compiled kernels."""

import re
import shutil
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path

from optodrive.cli.doctor_finding import Finding, report_ok, report_problem, report_warning
from optodrive.core.clock import Clock
from optodrive.link.transport.port_state import ROOT, join_root

MIN_PYTHON = (3, 11)
SLEEP_S = 0.001
OBSERVATION_S = 1.0
OVERSHOOT_WARNING_S = 0.01
CLOCK_RESOLUTION_MAX_S = 1e-4
DISK_LOW_BYTES = 1_000_000_000
DISK_FULL_BYTES = 50_000_000


def check_python() -> Finding:
    """The interpreter."""
    observation = sys.version.split()[0]
    if sys.version_info < MIN_PYTHON:
        return report_problem("python", observation, "use Python 3.11 or newer")
    return report_ok("python", observation)


def check_packages(name: str = "optodrive") -> list[Finding]:
    """What the package needs, as its own metadata says."""
    try:
        requirements = [text for text in metadata.requires(name) or [] if "extra ==" not in text]
    except metadata.PackageNotFoundError:
        return [report_warning("packages", f"{name} runs from its sources, not installed", "install it: pip install .")]
    violations = [violation for text in requirements if (violation := _check_requirement(text))]
    if violations:
        return [report_problem("packages", text, "install the package again: pip install .") for text in violations]
    return [report_ok("packages", f"all {len(requirements)} there")]


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
    """Whether the clock is fine enough, and the computer wakes in time: naps of 1 ms over a second."""
    resolution_s = time.get_clock_info("monotonic").resolution
    overshoot_s, end_s = 0.0, clock.now_s() + OBSERVATION_S
    while (before_s := clock.now_s()) < end_s:
        clock.sleep(SLEEP_S)
        overshoot_s = max(overshoot_s, clock.now_s() - before_s - SLEEP_S)
    observation = (
        f"resolution {resolution_s * 1e9:.0f} ns; a nap of 1 ms took at most {overshoot_s * 1e3:.2f} ms longer"
    )
    if resolution_s > CLOCK_RESOLUTION_MAX_S:
        return report_problem(
            "clock", observation, "the monotonic clock is too coarse: choose another clock source of the kernel's"
        )
    if overshoot_s > lease_s / 2:
        return report_problem(
            "clock", observation, f"half the lease of {lease_s:g} s and more: end other work on this computer"
        )
    if overshoot_s > OVERSHOOT_WARNING_S:
        return report_warning(
            "clock", observation, "the computer is busy or saves power: end other work, or set it to performance"
        )
    return report_ok("clock", observation)


def check_governor(root: Path = ROOT) -> Finding:
    """How the processor chooses its frequency."""
    folders = join_root(root, "/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq")
    governors = {_read_word(folder / "scaling_governor") for folder in folders} - {""}
    if not governors:
        return report_ok("processor", "its frequency is not this system's to choose")
    observation = "governor " + ", ".join(sorted(governors))
    if governors == {"performance"}:
        return report_ok("processor", observation)
    if "powersave" in governors:
        return report_warning("processor", observation, "wakes late: sudo cpupower frequency-set -g performance")
    return report_ok("processor", observation)


def _read_word(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""


def check_disk() -> list[Finding]:
    """Room here, and where temporary files go (the simulated board's log)."""
    folders = dict.fromkeys((Path.cwd(), Path(tempfile.gettempdir())))
    return [check_free_space(folder, shutil.disk_usage(folder).free) for folder in folders]


def check_free_space(folder: Path, free_bytes: int) -> Finding:
    """Whether logs and recordings of a link fit; an hour of 100 pulses a second is some 30 MB of recording."""
    observation = f"{free_bytes / 1e9:.1f} GB free in {folder}"
    if free_bytes < DISK_FULL_BYTES:
        return report_problem("disk", observation, "make room: logs and recordings stop when the disk is full")
    if free_bytes < DISK_LOW_BYTES:
        return report_warning("disk", observation, "make room, or record elsewhere")
    return report_ok("disk", observation)


def check_kernels() -> Finding:
    """Whether machine code is there already."""
    from optodrive.core.kernels import CACHED, is_cold

    if not CACHED:
        return report_warning(
            "kernels", "machine code cannot be kept", "make ~/.cache/optodrive writable, or set NUMBA_CACHE_DIR"
        )
    if is_cold():
        return report_warning(
            "kernels", "not compiled yet", "the first start takes half a minute: run `optodrive serve` once"
        )
    return report_ok("kernels", "compiled")
