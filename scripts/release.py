"""Build wheel and source of the present commit twice, compare them bit by bit, and list what an installation contains.

The bytes depend on the tracked files, on the version of the build tool, which pyproject.toml states, and on the
interpreter's compression library.
"""

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TOOLS = ("cyclonedx-bom==7.5.0",)
"""Programs that list the packages of an environment."""


def export_tree(folder):
    """Copy the tracked files, and nothing that lies beside them."""
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    for name in names.split("\0"):
        if (ROOT / name).is_file() and name:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)


def install_builder(folder):
    """Install the build tool that pyproject.toml states into a folder."""
    requirements = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "-q", "--target", folder]
    subprocess.run([*command, *requirements], check=True)


def build_distributions(source, builder, folder):
    """Build wheel and source of an exported tree. Return their paths."""
    environment = os.environ | {"PYTHONPATH": str(builder), "SOURCE_DATE_EPOCH": read_epoch()}
    command = [sys.executable, "-m", "hatchling", "build", "-d", folder]
    subprocess.run(command, cwd=source, env=environment, check=True, capture_output=True)
    return sorted(folder.iterdir())


def read_epoch():
    """Return the time of the present commit, s, which every file in the distributions has."""
    command = ["git", "log", "-1", "--format=%ct"]
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def compute_digests(paths):
    """Return the SHA-256 by name."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def build_twice(folder):
    """Build in two places for two users. Return the paths of the second, or end with the name of what differs."""
    install_builder(folder / "builder")
    built = []
    for place, umask in (("first", 0o077), ("further/second", 0o022)):
        source, out = folder / place / "source", folder / place / "out"
        mask = os.umask(umask)
        try:
            source.mkdir(parents=True)
            export_tree(source)
            built.append(build_distributions(source, folder / "builder", out))
        finally:
            os.umask(mask)
    if differing := find_differences(*map(compute_digests, built)):
        raise SystemExit(f"scripts/release: not reproducible: {', '.join(differing)}")
    return built[1]


def find_differences(first, second):
    """Return the names that only one build has, or that differ."""
    return sorted({name for name, _ in first.items() ^ second.items()})


def write_bill_of_materials(wheel, folder, path):
    """Install the wheel with what users may add, and list the packages in CycloneDX."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    users = ",".join(sorted(extras.keys() - {"dev", "docs"}))
    for name, requirements in (("installed", [f"{wheel}[{users}]"]), ("tools", TOOLS)):
        venv.create(folder / name, with_pip=True)
        pip = [folder / name / "bin" / "python", "-m", "pip", "--disable-pip-version-check", "install", "-q"]
        subprocess.run([*pip, *requirements], check=True)
    python = folder / "installed" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "uninstall", "-q", "-y", "pip", "setuptools"], check=True)
    lister = [folder / "tools" / "bin" / "cyclonedx-py", "environment", "--output-reproducible", "-o", path]
    environment = os.environ | {"SOURCE_DATE_EPOCH": read_epoch()}
    subprocess.run([*lister, "--pyproject", ROOT / "pyproject.toml", python], env=environment, check=True)


def main():
    parser = argparse.ArgumentParser(prog="scripts/release", description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder of the release")
    parser.add_argument("--quick", action="store_true", help="no bill of materials")
    options = parser.parse_args()
    if subprocess.run(["git", "status", "--porcelain", "-uno"], cwd=ROOT, check=True, capture_output=True).stdout:
        raise SystemExit("scripts/release: commit what you changed first")
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        built = build_twice(Path(temporary))
        for path in built:
            shutil.copy(path, options.out)
        sums = "".join(f"{digest}  {name}\n" for name, digest in compute_digests(built).items())
        (options.out / "SHA256SUMS").write_text(sums)
        print(sums, end="")
        if not options.quick:
            wheel = next(path for path in built if path.suffix == ".whl")
            version = wheel.name.split("-")[1]
            write_bill_of_materials(wheel, Path(temporary), options.out / f"optodrive-{version}.cdx.json")


if __name__ == "__main__":
    main()
