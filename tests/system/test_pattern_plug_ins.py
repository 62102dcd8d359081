"""Patterns of another package, installed by pip into a folder of its own: one that works and several that do not."""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from zipfile import ZipFile

import pytest

from optodrive.planning.stimuli.pattern_registry import PLUG_INS

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/how-to/add-a-pattern.md").read_text()
BROKEN = """
from optodrive.planning.stimuli.pattern import Pattern
from lab_patterns import CROSS
NUMBER = 3
TAKEN = Pattern("pixel", "another", (), CROSS.build)
OTHER = Pattern("other", "another name", (), CROSS.build)
UNTOLD = Pattern("untold", 5, (), CROSS.build)
RAISES = Pattern("raises", "one that raises", (), lambda config, where: 1 / 0)
NOTHING = Pattern("nothing", "one that returns nothing", (), lambda config, where: None)
"""
POINTS = {
    "absent": "no_such_module:A",
    "leaves": "lab_leaves:A",
    "number": "lab_broken:NUMBER",
    "pixel": "lab_broken:TAKEN",
    "named": "lab_broken:OTHER",
    "untold": "lab_broken:UNTOLD",
    "raises": "lab_broken:RAISES",
    "nothing": "lab_broken:NOTHING",
}


def write_wheel(folder, project, modules):
    """Write the wheel of a pure project, as a build of its pyproject.toml would."""
    name, version = project["name"].replace("-", "_"), project["version"]
    lines = [f"[{PLUG_INS}]", *(f"{each} = {value}" for each, value in project["entry-points"][PLUG_INS].items())]
    files = modules | {
        f"{name}-{version}.dist-info/METADATA": f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {version}\n",
        f"{name}-{version}.dist-info/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{name}-{version}.dist-info/entry_points.txt": "\n".join(lines) + "\n",
    }
    record = f"{name}-{version}.dist-info/RECORD"
    path = folder / f"{name}-{version}-py3-none-any.whl"
    with ZipFile(path, "w") as wheel:
        for file, text in {**files, record: "".join(f"{file},,\n" for file in [*files, record])}.items():
            wheel.writestr(file, text)
    return path


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """The environment of a process that finds the package of the page, with broken patterns beside its own."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("target")
    stated, module = (re.search(rf"```{kind}\n(.*?)```", PAGE, re.DOTALL)[1] for kind in ("toml", "python"))
    project = tomllib.loads(stated)["project"]
    project["entry-points"][PLUG_INS] |= POINTS
    modules = {"lab_patterns.py": module, "lab_broken.py": BROKEN, "lab_leaves.py": "raise SystemExit(3)\n"}
    wheel = write_wheel(source, project, modules)
    options = ["--quiet", "--no-index", "--no-deps", "--target", str(target)]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, str(wheel)], check=True)
    return {**os.environ, "PYTHONPATH": f"{ROOT}:{target}"}


def run(environment, *arguments):
    command = [sys.executable, "-c", "import sys; from optodrive.cli.main import run; sys.exit(run(sys.argv[1:]))"]
    return subprocess.run([*command, *arguments], env=environment, capture_output=True, text=True)


def test_a_pattern_of_another_package_is_listed_and_built(environment, tmp_path):
    found = run(environment, "patterns", "--json")
    assert found.returncode == 0, found.stderr
    listed = json.loads(found.stdout)
    assert [each["name"] for each in listed["patterns"][-3:]] == ["cross", "raises", "nothing"]
    assert set(listed["broken"]) == set(POINTS) - {"raises", "nothing"}
    assert all(reason.startswith("lab-patterns: ") for reason in listed["broken"].values())
    out = tmp_path / "cross.json"
    done = run(environment, "patterns", "cross", "height_um=80", "--out", str(out), "--config", "display-16")
    assert done.returncode == 0, done.stderr
    (frame,) = json.loads(out.read_text())["frames"]
    assert set(frame["target_um"].values()) == {80.0}
    assert sorted(map(int, frame["target_um"])) == [1, 4, 5, 6, 7, 9, 13]
    assert run(environment, "patterns", "cross", "height_um=8000", "--out", str(out)).returncode == 2


SAID = {
    "absent": (2, "ModuleNotFoundError: No module named 'no_such_module'"),
    "leaves": (2, "SystemExit: 3"),
    "number": (2, "a Pattern of the entry point's name number is expected"),
    "named": (2, "a Pattern of the entry point's name named is expected"),
    "untold": (2, "ValidationError"),
    "raises": (1, "pattern raises of lab-patterns: ZeroDivisionError: division by zero"),
    "nothing": (1, "pattern nothing of lab-patterns: AttributeError"),
    "crosss": (2, "nearest is 'cross'"),
}


EACH = """
import sys
from optodrive.cli.main import run
for name in sys.argv[2:]:
    print(run(["patterns", name, "--out", f"{sys.argv[1]}/{name}.json"]), file=sys.stderr)
"""


def test_one_that_does_not_work_is_one_line_and_costs_no_other(environment, tmp_path):
    command = [sys.executable, "-c", EACH, tmp_path, *SAID, "pixel"]
    lines = iter(subprocess.run(command, env=environment, capture_output=True, text=True).stderr.splitlines())
    for name, (status, said) in SAID.items():
        assert said in next(lines), name
        assert next(lines) == str(status), name
    assert list(lines) == ["0"], "a pattern of optodrive keeps its name"
