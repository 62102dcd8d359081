"""What the doctor looks at on the computer itself: Python, packages, clock, processor, disk, compiled kernels."""

import re
import shutil
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path

from optodrive.cli.doctor_finding import Finding, ok, problem, warning
from optodrive.core.clock import Clock
from optodrive.link.transport.port_state import ROOT, under

PYTHON_LEAST = (3, 11)
NAP_S = 0.001
WATCHED_S = 1.0
OVERSHOOT_NOTICED_S = 0.01
CLOCK_COARSE_S = 1e-4
DISK_LOW_BYTES = 1_000_000_000
DISK_FULL_BYTES = 50_000_000


def check_python() -> Finding:
    """The interpreter."""
    seen = sys.version.split()[0]
    if sys.version_info < PYTHON_LEAST:
        return problem("python", seen, "use Python 3.11 or newer")
    return ok("python", seen)


def check_packages(name: str = "optodrive") -> list[Finding]:
    """What the package needs, as its own metadata says."""
    try:
        needed = [text for text in metadata.requires(name) or [] if "extra ==" not in text]
    except metadata.PackageNotFoundError:
        return [warning("packages", f"{name} runs from its sources, not installed", "install it: pip install .")]
    bad = [complaint for text in needed if (complaint := _complaint(text))]
    if bad:
        return [problem("packages", text, "install the package again: pip install .") for text in bad]
    return [ok("packages", f"all {len(needed)} there")]


def _complaint(requirement: str) -> str | None:
    found = re.match(r"([\w.-]+)(?:\[[^]]*])?\s*(?:>=\s*([\d.]+))?", requirement)
    if found is None:
        return None
    name, least = found.groups()
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return f"{name} is missing"
    if least is not None and _numbers(version) < _numbers(least):
        return f"{name} {version} is older than {least}"
    return None


def _numbers(version: str) -> list[int]:
    return [int(part) for part in re.findall(r"\d+", version)[:3]]


def check_clock(clock: Clock, lease_s: float) -> Finding:
    """Whether the clock is fine enough, and the computer wakes in time: naps of 1 ms over a second."""
    resolution_s = time.get_clock_info("monotonic").resolution
    overshoot_s, until_s = 0.0, clock.now_s() + WATCHED_S
    while (before_s := clock.now_s()) < until_s:
        clock.sleep(NAP_S)
        overshoot_s = max(overshoot_s, clock.now_s() - before_s - NAP_S)
    seen = f"resolution {resolution_s * 1e9:.0f} ns; a nap of 1 ms took at most {overshoot_s * 1e3:.2f} ms longer"
    if resolution_s > CLOCK_COARSE_S:
        return problem("clock", seen, "the monotonic clock is too coarse: choose another clock source of the kernel's")
    if overshoot_s > lease_s / 2:
        return problem("clock", seen, f"half the lease of {lease_s:g} s and more: end other work on this computer")
    if overshoot_s > OVERSHOOT_NOTICED_S:
        return warning("clock", seen, "the computer is busy or saves power: end other work, or set it to performance")
    return ok("clock", seen)


def check_governor(root: Path = ROOT) -> Finding:
    """How the processor chooses its frequency."""
    folders = under(root, "/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq")
    governors = {_word(folder / "scaling_governor") for folder in folders} - {""}
    if not governors:
        return ok("processor", "its frequency is not this system's to choose")
    seen = "governor " + ", ".join(sorted(governors))
    if governors == {"performance"}:
        return ok("processor", seen)
    if "powersave" in governors:
        return warning("processor", seen, "wakes late: sudo cpupower frequency-set -g performance")
    return ok("processor", seen)


def _word(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""


def check_disk() -> list[Finding]:
    """Room here, and where temporary files go (the simulated board's log)."""
    folders = dict.fromkeys((Path.cwd(), Path(tempfile.gettempdir())))
    return [check_room(folder, shutil.disk_usage(folder).free) for folder in folders]


def check_room(folder: Path, free_bytes: int) -> Finding:
    """Whether logs and recordings of a link fit; an hour of 100 pulses a second is some 30 MB of recording."""
    seen = f"{free_bytes / 1e9:.1f} GB free in {folder}"
    if free_bytes < DISK_FULL_BYTES:
        return problem("disk", seen, "make room: logs and recordings stop when the disk is full")
    if free_bytes < DISK_LOW_BYTES:
        return warning("disk", seen, "make room, or record elsewhere")
    return ok("disk", seen)


def check_kernels() -> Finding:
    """Whether machine code is there already."""
    from optodrive.core.kernels import CACHED, is_cold

    if not CACHED:
        return warning(
            "kernels", "machine code cannot be kept", "make ~/.cache/optodrive writable, or set NUMBA_CACHE_DIR"
        )
    if is_cold():
        return warning("kernels", "not compiled yet", "the first start takes half a minute: run `optodrive serve` once")
    return ok("kernels", "compiled")
