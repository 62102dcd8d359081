"""Build the wheel, install it into an empty environment, and run `optodrive serve` outside the checkout."""

import argparse
import json
import os
import re
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

import httpx

ROOT = Path(__file__).resolve().parent.parent
TOKEN = "a-token-for-a-wheel"
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check")


def build_wheel(folder):
    """Build the wheel in isolation, and return its path."""
    subprocess.run([*PIP, "wheel", "-q", "--no-deps", "--wheel-dir", folder, ROOT], check=True)
    (wheel,) = folder.glob("optodrive-*.whl")
    return wheel


def install_wheel(wheel, folder, quick, base=sys.executable):
    """Install the wheel and its dependencies into an empty environment. Return the path of its `optodrive`.

    With `quick`, the dependencies of the current environment are used. `base` is the interpreter.
    """
    subprocess.run([base, "-m", "venv", "--without-pip", folder], check=True)
    python = folder / "bin" / "python"
    target = f"{wheel}" if quick else f"{wheel}[analysis]"
    subprocess.run([*PIP, "--python", python, "install", "-q", *(["--no-deps"] if quick else []), target], check=True)
    if quick:
        (site,) = folder.glob("lib/python*/site-packages")
        # A path line appends the folder to sys.path and ignores the .pth files in it.
        (site / "shared.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder / "bin" / "optodrive"


def try_installation(optodrive, outside):
    """Check the shipped configurations, run the daemon, and return its answers over HTTP."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    environment |= {"OPTODRIVE_TOKEN": TOKEN, "XDG_RUNTIME_DIR": str(outside)}

    def run_python(*arguments):
        command = [optodrive.with_name("python"), *arguments]
        return subprocess.run(command, cwd=outside, env=environment, check=True, text=True, capture_output=True).stdout

    package_path = Path(run_python("-c", "import optodrive; print(optodrive.__file__)").strip())
    if optodrive.parent.parent not in package_path.parents:
        raise SystemExit(f"scripts/wheel: {package_path} was imported, which is not the wheel")
    listing = "import json; from optodrive.device.config_file import *; print(json.dumps(list_shipped_configs()))"
    config_names = json.loads(run_python("-c", listing))
    for name in config_names:
        run_python("-m", "optodrive.cli.main", "config", "check", "--config", name)
    daemon = subprocess.Popen(
        [optodrive, "serve", "--config", "display-16", "--port", "0"],
        cwd=outside,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        url = re.search(r"http://[\d.:]+", daemon.stdout.readline())[0]
        with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {TOKEN}"}, timeout=60) as client:
            display = client.get("/v1/state").raise_for_status().json()["display"]
            frames = {"frames": [{"show_at_s": 0, "duration_s": 1, "target_um": {"3": 60}}]}
            plan = client.post("/v1/plans", params={"dry_run": True}, json=frames).raise_for_status().json()
            paths = client.get("/openapi.json").raise_for_status().json()["paths"]
            page = (package_path.parent / "daemon" / "page").is_dir()
            if page:
                client.get("/", headers={"Accept": "text/html"}).raise_for_status()
    finally:
        daemon.terminate()
        status = daemon.wait(timeout=20)
        daemon.stdout.close()
    return {"configs": config_names, "display": display, "planned": plan["planned"], "paths": len(paths), "page": page,
            "status": status}  # fmt: skip


def main():
    parser = argparse.ArgumentParser(prog="scripts/wheel", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="use the libraries of the current environment")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder of the wheel")
    parser.add_argument("--python", default=sys.executable, help="interpreter of the environment; not with --quick")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for old in options.out.glob("optodrive-*.whl"):
        old.unlink()
    wheel = build_wheel(options.out)
    with tempfile.TemporaryDirectory() as folder:
        outside = Path(folder) / "outside"
        outside.mkdir()
        installed = install_wheel(wheel, Path(folder) / "environment", options.quick, options.python)
        result = try_installation(installed, outside)
    print(json.dumps({"wheel": str(wheel), "bytes": wheel.stat().st_size, **result}))
    return 0 if result["planned"] == 1 and result["status"] == 0 and len(result["configs"]) == 5 else 1


if __name__ == "__main__":
    sys.exit(main())
