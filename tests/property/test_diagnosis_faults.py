"""A damaged or absurd recording is diagnosed or refused in one line, without warnings, within bounded memory."""

import json
import resource
import shutil
import warnings
from pathlib import Path
from random import Random

import h5py
import numpy as np
import pytest
from shown_output import COMPILATION

from labs import lab
from optodrive.cli.main import run
from optodrive.core.errors import InputError
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.recording import read_recording, write_recording

NUMBERS = (0.0, -1.0, 1e-300, 1e300, -1e300, 1e12, -1e12, 1e6, 1e-9, 2.0**31, 1e18, 5e-324, 3.0)
TEXTS = ("", "x" * 1000, "2024-13-45T99:00", "9999-12-31T23:59:59+00:00", "0001-01-01T00:00:00", "a\tb", "1e999", "nan")
TOKENS = (b"nan", b"inf", b"-1", b"1e308", b"9" * 400, b"\n", b",", b"0x1", b'"', b"\0", b"1_0", b";", b"\r\n")
EXTRA_BYTES = 2**30
"""Address space beyond what the process has, which a diagnosis of a small recording may take."""
QUICK = 4


def seeds(count, quick):
    return [pytest.param(seed, marks=() if seed < quick else pytest.mark.slow) for seed in range(count)]


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    folder = tmp_path_factory.mktemp("valid")
    droop = {"laser_droop": {"share": 0.08, "time": 0.05, "spread": 1.0}}
    measurement = lab(5, droop, groups=("short", "strong"), repeats=2, rate=200.0)
    write_recording(folder / "r.h5", measurement)
    write_recording(folder / "r", measurement)
    return folder


@pytest.fixture
def bounded_memory():
    """Let allocations of more than EXTRA_BYTES beyond the present fail."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + EXTRA_BYTES, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def diagnoses_or_refuses(path, capsys):
    capsys.readouterr()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        status = run(["diagnose", str(path), "--json", "-"])
    output, error = capsys.readouterr()
    error = COMPILATION.sub("", error)
    if status == 0:
        answer = json.loads(output, parse_constant=pytest.fail)
        assert answer["verdict"] in ("none", "instrument", "cause", "ambiguous", "unexplained", "incomplete")
        assert error == ""
        return
    assert status in (1, 2)
    assert output == ""
    assert error.startswith("optodrive: ")
    assert error.count("\n") == 1
    assert "Traceback" not in error


def change_field(file, rng):
    member = rng.choice(list(file["runs"].values()))
    signal = rng.choice([item for item in member.values() if isinstance(item, h5py.Group)])
    number = rng.choice(NUMBERS)
    part = rng.choice(
        ["ambient_K", "text", "attribute", "some", "scaled", "constant", "t_s", "later", "pulse", "column", "many"]
    )
    if part == "ambient_K":
        member.attrs[rng.choice(["ambient_K", "bridge_width_m", "aim_x_m"])] = number
    elif part == "text":
        member.attrs[rng.choice(["group", "started_at", "bridge_width_m", "sample"])] = rng.choice(TEXTS)
    elif part == "attribute":
        signal.attrs[rng.choice(["pixel", "sigma"])] = number
    elif part == "some":
        value = signal["value"][:]
        value[rng.sample(range(len(value)), 3)] = number
        signal["value"][:] = value
    elif part == "scaled":
        signal["value"][:] = signal["value"][:] * number
    elif part == "constant":
        signal["value"][:] = number
    elif part == "t_s":
        signal["t_s"][:] = signal["t_s"][:] * abs(number)
    elif part == "later":
        signal["t_s"][:] = signal["t_s"][:] + number
    elif part == "many":
        count = rng.choice([0, 1, 300])
        del member["pulses"]
        member["pulses"] = np.column_stack(
            [1e-3 * np.arange(count), np.full(count, 5e-4), np.full(count, 2.0), np.zeros(count)]
        )
    else:
        pulses, column = member["pulses"][:], rng.randrange(4)
        pulses[:, column] = pulses[:, column] * abs(number) if part == "column" else number
        member["pulses"][:] = pulses


@pytest.mark.parametrize("seed", seeds(200, QUICK))
def test_fields_of_any_size(seed, valid, tmp_path, capsys, bounded_memory):
    rng = Random(seed)
    path = tmp_path / "r.h5"
    shutil.copyfile(valid / "r.h5", path)
    with h5py.File(path, "r+") as file, np.errstate(all="ignore"):
        for _ in range(rng.randint(1, 2)):
            change_field(file, rng)
    diagnoses_or_refuses(path, capsys)


@pytest.mark.parametrize("seed", seeds(100, QUICK // 2))
def test_bytes_of_a_file(seed, valid, tmp_path, capsys, bounded_memory):
    rng = Random(seed)
    content = bytearray((valid / "r.h5").read_bytes())
    for _ in range(rng.randint(1, 8)):
        content[rng.randrange(len(content))] = rng.randrange(256)
    path = tmp_path / "r.h5"
    path.write_bytes(content)
    diagnoses_or_refuses(path, capsys)


@pytest.mark.parametrize("seed", seeds(100, QUICK))
def test_bytes_of_a_folder(seed, valid, tmp_path, capsys, bounded_memory):
    rng = Random(seed)
    path = tmp_path / "r"
    shutil.copytree(valid / "r", path)
    file = rng.choice(sorted(item for item in path.rglob("*") if item.is_file()))
    content = bytearray(file.read_bytes())
    where = rng.randrange(len(content))
    content[where : where + rng.randrange(5)] = rng.choice(TOKENS)
    file.write_bytes(content)
    diagnoses_or_refuses(path, capsys)


@pytest.mark.parametrize(
    ("place", "number", "message"),
    [
        ("displacement_m/value", 1e300, r"/displacement_m: got 1e\+300, expected a magnitude of at most 1e\+09 m"),
        (
            "displacement_m/t_s",
            1e12,
            r"/displacement_m/t_s: got 1000000000000\.0, expected a magnitude of at most 10000 s",
        ),
        (
            "pulses",
            [0.02, 1e12, 2.0, 0.0],
            r"/pulses: width_s: got 1000000000000\.0, expected a magnitude of at most 10000 s",
        ),
    ],
)
def test_numbers_that_no_diagnosis_computes_with_are_refused_by_name(valid, tmp_path, place, number, message):
    """They took hours and all memory, or overflowed in silence, and no error was found."""
    path = tmp_path / "r.h5"
    shutil.copyfile(valid / "r.h5", path)
    with h5py.File(path, "r+") as file:
        dataset = file[f"runs/run000/{place}"]
        values = dataset[:]
        values[-1] = number
        dataset[:] = values
    with pytest.raises(InputError, match=message):
        diagnose(read_recording(path))


@pytest.mark.parametrize(
    ("factor", "shift_s", "message"),
    [
        (1e-300, 0.0, "got samples 5e-303 s apart, expected 1e-09 s at least"),
        (1.0, 6000.0, "got 1200[01] s of runs, 6000 s of them in run000, expected at most 10000 s"),
    ],
)
def test_times_that_take_for_ever_are_refused(valid, tmp_path, factor, shift_s, message):
    path = tmp_path / "r.h5"
    shutil.copyfile(valid / "r.h5", path)
    with h5py.File(path, "r+") as file:
        for name in ("run000", "run001"):
            t_s = file[f"runs/{name}/displacement_m/t_s"]
            t_s[:] = factor * t_s[:] + shift_s
    with pytest.raises(InputError, match=message):
        diagnose(read_recording(path))
