"""A machine with its own running systemd, by systemd-nspawn over this machine's files, none of which it changes."""

import shutil
import subprocess
import sys
import sysconfig
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import optodrive

PROGRAM = "/opt/optodrive/optodrive"
BASE, PACKAGES, CHECKOUT = "/opt/optodrive/python", "/opt/optodrive/packages", "/opt/optodrive/checkout"
PYTHON = Path(BASE, "bin", Path(sys.executable).resolve().name)
BOOT_TIMEOUT_S = 240
ENVIRONMENT = f"Environment=PYTHONPATH={CHECKOUT}:{PACKAGES} LD_LIBRARY_PATH={BASE}/lib"
"""Line of a unit that starts PROGRAM: the package, and the library of an interpreter from another place."""
UNIT = f"""[Unit]
Description=the test
[Service]
Type=oneshot
{ENVIRONMENT}
ExecStart=/bin/sh /opt/optodrive/script
ExecStopPost=systemctl --no-block poweroff
StandardOutput=file:/opt/optodrive/results
StandardError=file:/opt/optodrive/errors
"""


@cache
def find_obstacle():
    """Return why no such machine can be started here, None if it can."""
    if shutil.which("systemd-nspawn") is None:
        return "systemd-nspawn is missing: apt-get install systemd-container"
    tried = subprocess.run(
        ["unshare", "--mount", "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True, text=True
    )
    return f"no machine can be started: {tried.stderr.strip()}" if tried.returncode else None


@contextmanager
def machine_files(folder):
    """Yield the root of a copy of this machine's files, whose changes are kept in memory."""
    memory, root = folder / "memory", folder / "machine"
    memory.mkdir()
    root.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "tmpfs", memory], check=True)
    try:
        (memory / "upper").mkdir()
        (memory / "work").mkdir()
        layers = f"lowerdir=/,upperdir={memory}/upper,workdir={memory}/work"
        subprocess.run(["mount", "-t", "overlay", "overlay", "-o", layers, root], check=True)
        try:
            yield root
        finally:
            subprocess.run(["umount", "--lazy", root], check=True)
    finally:
        subprocess.run(["umount", "--lazy", memory], check=True)


def run_script(root, script):
    """Boot the machine, run a shell script as root in it, power it off. Return the script's stdout and stderr."""
    place = root / "opt/optodrive"
    for name in ("python", "packages", "checkout"):
        (place / name).mkdir(parents=True, exist_ok=True)
    program = root / PROGRAM.lstrip("/")
    program.write_text(f"#!{PYTHON}\nfrom optodrive.cli.main import main\nmain()\n")
    program.chmod(0o755)
    (place / "script").write_text(script)
    (root / "etc/systemd/system/test.service").write_text(UNIT)
    (root / "etc/systemd/system/test.target").write_text(
        "[Unit]\nRequires=sysinit.target basic.target\nWants=test.service\n"
    )
    (root / "etc/machine-id").write_text("")
    binds = {
        sys.base_prefix: BASE,
        sysconfig.get_path("purelib"): PACKAGES,
        str(Path(optodrive.__file__).parents[1]): CHECKOUT,
    }
    options = [f"--bind-ro={source}:{target}" for source, target in binds.items()]
    # systemd-nspawn without a systemd on this machine: it registers nothing.
    command = ["systemd-nspawn", "-D", root, "--register=no", "--keep-unit", "--private-network", "--console=pipe"]
    subprocess.run(
        [*command, *options, "--boot", "systemd.unit=test.target"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        timeout=BOOT_TIMEOUT_S,
        check=True,
    )
    return (place / "results").read_text(), (place / "errors").read_text()
