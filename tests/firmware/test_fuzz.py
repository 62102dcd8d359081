"""libFuzzer on the C core: no violation in as many inputs on every machine, and detection of each disabled guard."""

import shutil
import subprocess
from pathlib import Path

import pytest

FUZZ = Path(__file__).with_name("fuzz")
INPUTS = {"decoder": 30_000, "board": 2_500}
LONG_INPUTS = {"decoder": 1_000_000, "board": 50_000}
"""Half a minute. The last of the disabled guards is noticed after a tenth to a fifth of them."""
LONGEST = {"decoder": 1024, "board": 512}
FOUND_BEFORE = {
    # A reset far from the centre, then a point there: the core assumed a mirror position that it had not commanded.
    "mirrors after a reset": ("board", "01 03 00 06 00 78 17 cd 03 04 00 00 02"),
}


def build(folder, target, mutant=0):
    """Build a fuzz target outside the source tree."""
    missing = [tool for tool in ("clang", "make") if shutil.which(tool) is None]
    assert not missing, f"the fuzzers need {' and '.join(missing)}: apt-get install clang libclang-rt-dev make"
    program = folder / (f"{target}-{mutant}" if mutant else target)
    command = ["make", "-s", "-C", FUZZ, f"BUILD={folder}", f"MUTANT={mutant}", program]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, f"{built.stderr}\nno libclang_rt.fuzzer? apt-get install libclang-rt-dev"
    return program


def start(program, count, *paths):
    """Run the fuzzer on `count` inputs from an empty corpus, or on the inputs in files."""
    longest = LONGEST[program.name.partition("-")[0]]
    options = [f"-runs={count}", f"-max_len={longest}", "-seed=1", f"-artifact_prefix={program}-found-"]
    return subprocess.Popen([program, *options, *paths], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.parametrize(
    "counts",
    [INPUTS, pytest.param(LONG_INPUTS, marks=[pytest.mark.slow, pytest.mark.timeout(600)])],
    ids=["few", "many"],
)
def test_nothing_is_found(folder, counts):
    fuzzers = [start(build(folder, target), count) for target, count in counts.items()]
    for fuzzer in fuzzers:
        reported = fuzzer.communicate()[1]
        assert fuzzer.returncode == 0, reported[-5000:]
        assert "Done" in reported


@pytest.mark.parametrize("what", FOUND_BEFORE)
def test_what_was_found_is_mended(folder, what):
    target, steps = FOUND_BEFORE[what]
    path = folder / "steps"
    path.write_bytes(bytes.fromhex(steps))
    fuzzer = start(build(folder, target), 1, path)
    reported = fuzzer.communicate()[1]
    assert fuzzer.returncode == 0, reported[-5000:]


@pytest.mark.timeout(600)  # of the inputs that a core whose fault is not noticed would take
@pytest.mark.parametrize(
    ("target", "mutant", "says"),
    [
        pytest.param(*("board", 1, "oracle: B1: "), marks=pytest.mark.slow),
        pytest.param(*("board", 3, "oracle: B3: "), marks=pytest.mark.slow),
        pytest.param(*("board", 7, "oracle: B7: "), marks=pytest.mark.slow),
        ("board", 9, "oracle: B9: "),
        pytest.param(*("board", 16, "oracle: B9: "), marks=pytest.mark.slow),
        ("decoder", 101, "AddressSanitizer: heap-buffer-overflow"),
        pytest.param(*("decoder", 102, "out of bounds for type 'uint8_t[253]'"), marks=pytest.mark.slow),
    ],
)
def test_a_core_without_a_check_is_detected(folder, target, mutant, says):
    fuzzer = start(build(folder, target, mutant), LONG_INPUTS[target])
    reported = fuzzer.communicate()[1]
    assert fuzzer.returncode != 0, "the fuzzer does not notice"
    assert says in reported, reported[-5000:]
