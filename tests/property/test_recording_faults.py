"""A modified recording is read or refused in one line, without any other error or a hang."""

import shutil

import h5py
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from optodrive.core.errors import InputError
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.recording import RecordingIndex, hdf5, read_recording, reader, write_recording
from optodrive.lab.recording.storage import SIGNALS

T_S = np.linspace(0.0, 1.0, 20)
PULSES = np.array([[0.0, 0.1, 2.0, 3.0], [0.5, 0.1, 2.0, 4.0]])
SIGNALS_OF = {"displacement_m": Signal(3, T_S, T_S, 1e-7), "mirror_x_rad": Signal(0, T_S, T_S)}
COMMANDS = np.column_stack([T_S, T_S, T_S])
VALID = Measurement(
    tuple(Run(f"run{k}", 293.15, PULSES, SIGNALS_OF, {"sample": "x", "group": "g"}, COMMANDS) for k in (1, 2))
)
RUNS = ("runs/run1", "runs/run2")
PLACES = [
    "/",
    "runs",
    *RUNS,
    *(f"{run}/{name}" for run in RUNS for name in ("pulses", "commands", *SIGNALS_OF)),
    *(f"{run}/{name}/{part}" for run in RUNS for name in SIGNALS_OF for part in ("t_s", "value")),
]
KEYS = ["format", "version", "instrument_notes", "ambient_K", "group", "pixel", "sigma", "unit"]
NAMES = [*SIGNALS, "pulses", "commands", "t_s", "value", "displacement_mm", "run10", "a\nb", "..", "ü", " "]
NUMBERS = st.floats() | st.integers(-(2**63), 2**63 - 1) | st.sampled_from([0.0, -1.0, 1e308, 293.15, 2**31])
VALUES = (
    NUMBERS
    | st.booleans()
    | st.complex_numbers()
    | st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=8)
    | st.binary(max_size=8).map(np.bytes_)
    | st.binary(min_size=1, max_size=8).map(np.void)
    | st.just(h5py.Empty("f8"))
    | st.just(np.array((1, 2.0), dtype=[("a", "i4"), ("b", "f8")]))
    | st.lists(NUMBERS, max_size=3).map(lambda numbers: np.array(numbers, dtype=float))
    | st.lists(st.sampled_from(["a", "1.0"]), min_size=1, max_size=3)
)
DTYPES = (
    npst.floating_dtypes(endianness="?")
    | npst.integer_dtypes(endianness="?")
    | npst.boolean_dtypes()
    | npst.complex_number_dtypes()
    | st.just(np.dtype("S3"))
    | st.just(np.dtype("V2"))
)
SHAPES = st.sampled_from([(), (0,), (1,), (4,), (20,), (2, 4), (0, 4), (20, 3), (2, 3), (20, 1), (1, 20), (2, 2, 2)])
ARRAYS = DTYPES.flatmap(lambda dtype: SHAPES.flatmap(lambda shape: npst.arrays(dtype, shape)))
CLAIMED = st.sampled_from([(2**40,), (2**40, 4), (2**31, 2**31), (2**29,)])


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    folder = tmp_path_factory.mktemp("valid")
    write_recording(folder / "r.h5", VALID)
    write_recording(folder / "folder", VALID)
    return folder


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("damaged") / "r.h5"


def read_or_refuse(read, path):
    """Return the recording, or None if it is refused."""
    try:
        return read(path)
    except InputError as error:
        message = str(error)
    assert "\n" not in message
    assert "expected" in message
    return None


def reads_or_refuses(path):
    """Check that reading refuses every file that the index refuses."""
    index, measurement = read_or_refuse(RecordingIndex.open, path), read_or_refuse(read_recording, path)
    if measurement is None:
        return
    assert index is not None
    assert [run.name for run in measurement.runs] == [run.name for run in index.runs]
    for run, listed in zip(measurement.runs, index.runs, strict=True):
        assert_in_order(run)
        counts = {name: len(signal.t_s) for name, signal in run.signals.items()}
        assert {name: signal.sample_count for name, signal in listed.signals.items()} == counts


def assert_in_order(run):
    assert 150.0 <= run.ambient_k <= 600.0
    assert run.pulses.dtype == np.float64
    assert run.pulses.shape[1] == 4
    assert np.all(np.isfinite(run.pulses))
    assert np.all(run.pulses >= [-np.inf, 0, 0, 0])
    assert all(isinstance(value, str | int | float) for value in run.attributes.values())
    assert run.signals.keys() <= set(SIGNALS)
    for signal in run.signals.values():
        assert signal.t_s.dtype == signal.value.dtype == np.float64
        assert np.all(np.isfinite(signal.t_s))
        assert np.all(signal.t_s[1:] > signal.t_s[:-1])
        assert np.any(np.isfinite(signal.value))
        assert not np.any(np.isinf(signal.value))


@settings(max_examples=3 * settings.default.max_examples // 10)
@given(st.data())
def test_bytes_changed_or_cut_off(valid, path, data):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hdf5, "CPU_LIMIT_S", 2)
        content = bytearray((valid / "r.h5").read_bytes())
        for _ in range(data.draw(st.integers(0, 8))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
        path.write_bytes(content[: data.draw(st.just(len(content)) | st.integers(0, len(content)))])
        reads_or_refuses(path)


def set_attribute(file, draw):
    file[draw(st.sampled_from(PLACES))].attrs[draw(st.sampled_from(KEYS))] = draw(VALUES)


def delete_attribute(file, draw):
    attrs = file[draw(st.sampled_from(PLACES))].attrs
    if attrs:
        del attrs[draw(st.sampled_from(sorted(attrs)))]


def delete(file, draw):
    del file[draw(st.sampled_from(PLACES[1:]))]


def put_dataset(file, draw):
    place = draw(st.sampled_from(PLACES[1:]))
    if place in file:
        del file[place]
    file.create_dataset(place, data=draw(ARRAYS))


def claim(file, draw):
    place = draw(st.sampled_from(PLACES[4:]))
    if place in file:
        del file[place]
    file.create_dataset(place, shape=draw(CLAIMED), dtype="f8", chunks=True)


def set_entry(file, draw):
    dataset = file[draw(st.sampled_from(PLACES))]
    if isinstance(dataset, h5py.Dataset) and dataset.dtype == np.float64 and 0 < dataset.size < 100:
        flat = dataset[()].reshape(-1)
        flat[draw(st.integers(0, dataset.size - 1))] = draw(NUMBERS)
        dataset[...] = flat.reshape(dataset.shape)


def add(file, draw):
    name = f"{draw(st.sampled_from(PLACES[1:4]))}/{draw(st.sampled_from(NAMES))}"
    file.require_group(name) if draw(st.booleans()) else file.create_dataset(name, data=draw(ARRAYS))


def link(file, draw):
    place = draw(st.sampled_from(PLACES[1:]))
    other = draw(st.sampled_from(PLACES))
    if place in file:
        del file[place]
    file[place] = draw(st.sampled_from([h5py.SoftLink(f"/{other}"), h5py.ExternalLink("elsewhere.h5", "/")]))


def move(file, draw):
    file.move(draw(st.sampled_from(PLACES[1:])), f"{draw(st.sampled_from(RUNS))}/{draw(st.sampled_from(NAMES))}")


CHANGES = [set_attribute, delete_attribute, delete, put_dataset, claim, set_entry, add, link, move]


@settings(max_examples=6 * settings.default.max_examples // 5)
@given(st.data())
def test_members_attributes_and_datasets_replaced(valid, path, data):
    shutil.copyfile(valid / "r.h5", path)
    with h5py.File(path, "r+") as file:
        for change in data.draw(st.lists(st.sampled_from(CHANGES), min_size=1, max_size=4)):
            # The library refuses to write what a file cannot hold.
            try:
                change(file, data.draw)
            except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError, OverflowError):
                continue
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reader, "probe_in_sandbox", lambda path: None)  # written by the library, hence harmless
        reads_or_refuses(path)


@settings(max_examples=3 * settings.default.max_examples // 2)
@given(st.data())
def test_files_of_the_folder_changed(valid, tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp() / "damaged-folder"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(valid / "folder", folder)
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    for _ in range(data.draw(st.integers(1, 3))):
        file = data.draw(st.sampled_from(files))
        content = bytearray(file.read_bytes() if file.exists() else b"")
        where = data.draw(st.integers(0, len(content)))
        inserted = data.draw(st.binary(max_size=3) | st.sampled_from(CELLS).map(str.encode))
        content[where : where + data.draw(st.integers(0, 4))] = inserted
        file.unlink(missing_ok=True)
        if data.draw(st.integers(0, 9)):
            file.write_bytes(content)
    reads_or_refuses(folder)


CELLS = [
    "nan",
    "inf",
    "-1",
    "1e999",
    "9" * 5000,
    "\n",
    ",",
    "0x1",
    "[",
    "]",
    '"',
    "{",
    "= 3\n",
    "[" * 2000,
    "\0",
    "1_0",
]
ATTRIBUTES = st.dictionaries(
    st.text(st.characters(exclude_categories=["Cs", "Cc", "Z"]), min_size=1, max_size=8).filter(str.isprintable),
    st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=12)
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False),
    max_size=4,
)
FINITE = st.floats(allow_nan=False, allow_infinity=False)


@settings(max_examples=3 * settings.default.max_examples // 5)
@given(
    st.lists(FINITE, min_size=6, max_size=12, unique=True),
    st.lists(FINITE | st.just(np.nan), min_size=12, max_size=12),
    ATTRIBUTES,
    st.floats(150.0, 600.0),
    st.none() | st.floats(1e-300, 1e300),
)
@example([*range(6)], [0.0] * 12, {"n": 2**64 - 1, "m": -(2**63)}, 300.0, None)
def test_every_number_and_text_comes_back_from_both_forms(
    tmp_path_factory, times, values, attributes, ambient_k, sigma
):
    t_s = np.array(sorted(times))
    value = np.array([*times, *values])
    signal = Signal(5, np.linspace(0.0, 1.0, len(value)), value, sigma)
    run = Run("a", ambient_k, PULSES, {"force_N": signal, "displacement_m": Signal(5, t_s, t_s)}, attributes)
    base = tmp_path_factory.getbasetemp() / "round"
    for path in (base / "r.h5", base / "folder"):
        shutil.rmtree(base, ignore_errors=True)
        base.mkdir()
        write_recording(path, Measurement((run,)))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(reader, "probe_in_sandbox", lambda path: None)
            (read,) = read_recording(path).runs
        assert (read.ambient_k, read.attributes) == (ambient_k, attributes)
        assert read.signals["force_N"].sigma == sigma
        assert np.array_equal(read.signals["force_N"].value, value, equal_nan=True)
        assert np.array_equal(read.signals["displacement_m"].t_s, t_s)
