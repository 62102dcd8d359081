"""Patterns and terms of other packages, built and installed by pip: the example's, and several that do not work."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "docs" / "examples" / "lab-optodrive"
BROKEN = """
from optodrive.planning.stimuli.pattern import Pattern
from lab_optodrive.patterns import CROSS
NUMBER = 3
TAKEN = Pattern("pixel", "another", (), CROSS.build)
OTHER = Pattern("other", "another name", (), CROSS.build)
UNTOLD = Pattern("untold", 5, (), CROSS.build)
RAISES = Pattern("raises", "one that raises", (), lambda config, where: 1 / 0)
NOTHING = Pattern("nothing", "one that returns nothing", (), lambda config, where: None)
"""
BROKEN_TERMS = """
from optodrive.core.kernels import kernel
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import ABSORBER, NO_HEAT_GAIN, Kernels, Term
def plain(v, y, s, c, x):
    return x * v[0]
@kernel
def twice(v, y, s, c, x):
    return 2.0 * x * v[0]
@kernel
def second(v, y, s, c, x):
    return x + v[1]
@kernel
def inverse(v, y, s, c, x):
    return x / (v[0] - 1.0)
@kernel
def texts(v, y, s, c, x):
    return x + len({"a": v})
@kernel
def into_absorber(v, y, s, c, x):
    x[ABSORBER] += v[0]
def make(name, low=1.0, **kernels):
    members = {"key": name, "label": name, "__doc__": name, "kernels": Kernels(**kernels), "cannot_add_heat": True}
    members["parameters"] = (TermParameter("factor", "1", 1.5, low, 2.0, "a test"),)
    members["bound_heat_gain"] = lambda self, values, envelope: NO_HEAT_GAIN
    return type(name, (Term,), members)
class untold(make("untold")):
    pass
untold.__doc__ = ""
heat_capacity, other = make("heat_capacity"), make("another")
low_default, undecorated = make("low_default", low=1.8), make("undecorated", displacement=plain)
beyond, no_number = make("beyond", displacement=second), make("no_number", displacement=inverse)
uncompiled, warms = make("uncompiled", displacement=texts), make("warms", rates=into_absorber)
hotter = make("hotter", optical_power=twice)
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
TERMS = {
    "absent": "ModuleNotFoundError: No module named 'no_such_module'",
    "heat_capacity": "ValueError: another term has this name",
    "other": "TypeError: a class of Term with the entry point's name other as its key is expected",
    "untold": "ValueError: a docstring with the equation, a label and parameters are expected",
    "low_default": "ValueError: factor: default and starts from low to high are expected",
    "undecorated": "TypeError: displacement: a function with the decorator optodrive.core.kernels.kernel is expected",
    "beyond": "IndexError: index 1 is out of bounds for axis 0 with size 1",
    "no_number": "ValueError: displacement: no number at parameters [1.0] and a rise of 0 K",
    "uncompiled": "TypingError",
    "warms": "ValueError: rates: rates of its own followers only are expected",
}
"""Terms that cannot be used, and why."""


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """The environment of a process that finds the example's package, and another one that does not work."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("target")
    shutil.copytree(EXAMPLE, source / "lab-optodrive")
    broken = source / "lab-broken"
    broken.mkdir()
    files = {"lab_broken.py": BROKEN, "lab_leaves.py": "raise SystemExit(3)\n", "lab_terms.py": BROKEN_TERMS}
    for name, text in files.items():
        (broken / name).write_text(text)
    points = {"patterns": POINTS, "terms": {"absent": "no_such_module:A"}}
    points["terms"] |= {name: f"lab_terms:{name}" for name in (*TERMS, "hotter") if name != "absent"}
    groups = [
        f'[project.entry-points."optodrive.{group}"]\n' + "".join(f'{name} = "{at}"\n' for name, at in each.items())
        for group, each in points.items()
    ]
    head = (EXAMPLE / "pyproject.toml").read_text().partition("[project.entry-points")[0]
    included = f"[tool.hatch.build.targets.wheel]\ninclude = {json.dumps(list(files))}\n"
    text = head.replace("lab-optodrive", "lab-broken") + "".join(groups) + included
    assert tomllib.loads(text)["project"]["name"] == "lab-broken"
    (broken / "pyproject.toml").write_text(text)
    options = ["--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--target", str(target)]
    places = [str(source / "lab-optodrive"), str(broken)]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, *places], check=True)
    return {**os.environ, "PYTHONPATH": f"{ROOT}:{target}"}


def run(environment, *arguments):
    command = [sys.executable, "-c", "import sys; from optodrive.cli.main import run; sys.exit(run(sys.argv[1:]))"]
    return subprocess.run([*command, *arguments], env=environment, capture_output=True, text=True)


def test_a_pattern_of_another_package_is_listed_and_built(environment, tmp_path):
    found = run(environment, "patterns", "--json")
    assert found.returncode == 0, found.stderr
    listed = json.loads(found.stdout)
    assert sorted(each["name"] for each in listed["patterns"][-3:]) == ["cross", "nothing", "raises"]
    assert set(listed["broken"]) == set(POINTS) - {"raises", "nothing"}
    assert all(reason.startswith("lab-broken: ") for reason in listed["broken"].values())
    out = tmp_path / "cross.json"
    done = run(environment, "patterns", "cross", "height_um=80", "--out", str(out), "--config", "display-16")
    assert done.returncode == 0, done.stderr
    (frame,) = json.loads(out.read_text())["frames"]
    assert set(frame["target_um"].values()) == {80.0}
    assert sorted(map(int, frame["target_um"])) == [1, 4, 5, 6, 7, 9, 13]
    assert run(environment, "patterns", "cross", "height_um=8000", "--out", str(out)).returncode == 2


def test_terms_of_another_package_are_listed_and_those_that_do_not_work_say_why(environment):
    listed = run(environment, "terms", "--json")
    assert listed.returncode == 0, listed.stderr
    answer = json.loads(listed.stdout)
    assert {"membrane_slack", "hotter", "heat_capacity"} < {term["key"] for term in answer["terms"]}
    assert set(answer["broken"]) == set(TERMS)
    for name, reason in TERMS.items():
        assert answer["broken"][name].startswith(f"lab-broken: {reason}"), answer["broken"][name]
    described = run(environment, "terms", "beyond")
    assert described.returncode == 2
    assert "lab-broken: IndexError" in described.stderr


BOUND = """
from pathlib import Path
from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config
from optodrive.physics import term_plug_ins
from optodrive.physics.parameters import build_display_pixels, load_parameters
from optodrive.physics.term_reference import build_example_file
from optodrive.physics.terms import discover_terms
from optodrive.planning.budget_setup import compute_heat_gain_bound
def bound(name):
    path = Path(f"{name}.toml")
    path.write_text("\\n".join(build_example_file(discover_terms()[name])))
    parameters, config = load_parameters(path), load_config("display-16")
    try:
        print(compute_heat_gain_bound(parameters, build_display_pixels(config, parameters), config).power_factor)
    except InputError as error:
        print(error)
bound("membrane_slack")
bound("hotter")
term_plug_ins.HEAT_HOOKS = ()  # mutant: what it says of its heat is believed
bound("hotter")
"""


def test_no_cap_rests_on_what_another_package_says_of_its_heat(environment, tmp_path):
    """It doubles the light and states that it adds no heat."""
    command = [sys.executable, "-c", BOUND]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=tmp_path)
    expected = "a term of optodrive, or one without a kernel of light or heat: no test proves another's bound"
    refused = f"terms.hotter: got 'hotter', expected {expected}"
    assert done.stdout.splitlines() == ["1.0", refused, "1.0"], done.stderr


@pytest.mark.slow  # all kernels are compiled anew for the further terms
def test_the_example_passes_its_own_tests_and_its_term_is_simulated_and_planned_with(environment, tmp_path):
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", EXAMPLE / "tests"]
    own = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=tmp_path)
    assert "2 passed" in own.stdout, own.stdout
    model, frames = tmp_path / "slack.toml", tmp_path / "frames.json"
    stated = run(environment, "terms", "membrane_slack").stdout.split("\nmodel.toml:\n\n")[1]
    model.write_text(stated.replace("claims", 'planner_terms = ["membrane_slack"]\nclaims', 1))
    frames.write_text('{"frames": [{"show_at_s": 0, "duration_s": 0.5, "target_um": {"5": 50}}]}')
    given = (str(frames), "--config", "display-16")
    loose = run(environment, "simulate", *given, "--pixels", "5", "--truth", str(model))
    assert "pixel 5          45.2 µm measured, 50.0 µm predicted" in loose.stdout, loose.stdout + loose.stderr
    plans = [run(environment, "plan", *given, "--json", *options) for options in ((), ("--model", str(model)))]
    taut, slack = (json.loads(plan.stdout) for plan in plans)
    # The membrane must rise to √(55² − 5²) µm for 50 µm beyond its slack, and energy is almost in proportion.
    assert slack["energy_j"] / taut["energy_j"] == pytest.approx(1.095, abs=0.01)
    assert slack["predicted_max_um"] == pytest.approx(50.0)


SAID = {
    "absent": (2, "ModuleNotFoundError: No module named 'no_such_module'"),
    "leaves": (2, "SystemExit: 3"),
    "number": (2, "a Pattern of the entry point's name number is expected"),
    "named": (2, "a Pattern of the entry point's name named is expected"),
    "untold": (2, "ValidationError"),
    "raises": (1, "pattern raises of lab-broken: ZeroDivisionError: division by zero"),
    "nothing": (1, "pattern nothing of lab-broken: AttributeError"),
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
