"""Every example of README and docs: commands exist with their options, and run as written."""

import contextlib
import json
import re
import shlex
import tomllib

import pytest
import typer
from pages import COMMENT, ROOT, is_command, list_blocks, list_examples, list_pages
from shown_output import find_difference
from worlds import (
    compare_outputs,
    find_obstacle,
    run_script,
    write_calibration,
    write_checkout,
    write_film,
    write_measured,
    write_motor,
    write_recordings,
    write_script,
    write_slack,
    write_stimuli,
)

from optodrive.cli.commands import UsageError, build_app, name_default

ELSEWHERE = {
    "scripts/": "scripts of the checkout, which are run as they are",
    "optodrive board": "tests/firmware/test_board_build.py, tests/unit/cli/test_board_flash.py",
    "SILVERBOX_CSV=": "tests/accuracy/test_discovery.py, where the file is at hand",
    "optodrive discover damper.py": "measured data that is not part of the repository",
    "python tests/blind/blind_instruments.py": "tests/blind/test_instruments.py runs its cases",
    "python3 -m venv": "tests/system/test_wheel.py checks the wheel",
    "/opt/optodrive/": "tests/system/test_service.py runs the commands of the service",
    "openssl req -x509": "tests/system/test_tls_proxy.py makes its certificate so",
    "optodrive braille": "tests/system/test_braille_command.py",
    "optodrive osc": "tests/system/test_osc.py",
    "optodrive fingers": "tests/system/test_standing_frames.py",
    "optodrive study my-study.toml --out data --participant 07 --hold": "tests/browser/test_study_participant.py",
    "optodrive study my-study.toml --out data --participant 07 --lsl": "tests/system/test_study_streams.py",
    "optodrive serve --config mine.toml": "tests/system/test_dac_daemon.py",
    "optodrive dac": "tests/dac plays on the DACs' own protocols; no device is here",
    "optodrive home": "a synopsis; tests/system/test_home.py",
    "optodrive doctor --config display.toml": "tests/system/test_stages.py",
    "optodrive doctor --board": "tests/unit/cli/test_doctor_bare_board.py",
    "optodrive first-light --stage": "tests/unit/device/test_stage_config.py",
    "optodrive calibrate board": "a synopsis; tests/system/test_calibrate_loop.py",
    "optodrive diagnose --live": "a synopsis; tests/system/test_diagnose_live.py",
    "optodrive calibrate camera": "tests/accuracy/test_calibrate_camera.py renders its pictures",
    "optodrive calibrate film": "tests/system/test_finger_trackers.py",
    "optodrive fingers --camera": "tests/system/test_finger_trackers.py",
    "optodrive fingers --film": "tests/system/test_finger_trackers.py",
    "optodrive calibrate pixels": "tests/accuracy/test_calibrate_pixels.py records its sweep, which takes minutes",
    "optodrive calibrate servo recording.h5 --stage": "tests/accuracy/test_calibrate_servo.py",
    "optodrive calibrate servo responses.npz": "tests/accuracy/test_servo_effects.py",
    "optodrive calibrate sweep": "tests/system/test_calibrate_sweep.py",
    "optodrive recording merge sweep/": "tests/unit/lab/commissioning/test_sweep_player.py",
    "optodrive token": "tests/unit/cli/test_token_command.py",
    "optodrive plan frames.json --pixel-map": "tests/accuracy/test_calibrate_pixels.py",
    "optodrive simulate sweep/": "tests/accuracy/test_calibrate_pixels.py",
    "pip install ./lab-optodrive": "tests/system/test_plug_ins.py installs it",
    "optodrive diagnose film.h5 --out cluster/ --dask": "tests/accuracy/test_display_diagnosis.py starts a cluster",
}
"""Beginnings of examples that are not run here, and where they are."""

COMPARED_ELSEWHERE = {"optodrive calibrate camera": "tests/accuracy/test_calibrate_camera.py"}
"""Beginnings of examples whose output another test compares, and that test."""

SCENARIOS = {
    "readme": (write_checkout, ["README.md:Shell", "README.md:Python"]),
    "readme-rest": (write_checkout, ["README.md:REST"]),
    "patterns": (write_stimuli, ["docs/how-to/show-stimuli.md:Patterns"]),
    "fits": (write_checkout, ["docs/how-to/show-stimuli.md:Whether it fits"]),
    "refusals": (write_recordings, ["docs/reference/recordings.md:Refusals"]),
    "unusable": (write_recordings, ["docs/reference/recordings.md:What cannot be used"]),
    "quickstart": (write_checkout, ["docs/tutorials/quickstart.md:Quickstart"]),
    "configuration": (write_checkout, ["docs/how-to/write-a-configuration.md:A new one"]),
    "client": (write_checkout, ["docs/how-to/use-the-python-client.md:Python client"]),
    "standing": (write_checkout, ["docs/how-to/read-by-fingers.md:A frame that stands"]),
    "diagnosis": (
        write_recordings,
        ["docs/explanation/diagnosis.md:Diagnosis", "docs/explanation/diagnosis.md:Planning with a diagnosed model"],
    ),
    "studies": (
        write_checkout,
        ["docs/how-to/run-a-study.md:The paper's experiments, simulated", "docs/how-to/find-thresholds.md:Thresholds"],
    ),
    "discovery": (write_motor, ["docs/how-to/discover-a-term.md:Find what a simulation lacks"]),
    "discovery-in-a-pixel": (write_slack, ["docs/how-to/discover-a-term.md:In a pixel"]),
    "analysis": (
        write_checkout,
        ["docs/how-to/analyse-a-study.md:Power, before the study", "docs/how-to/analyse-a-study.md:The report"],
    ),
    "film": (write_film, ["docs/explanation/diagnosis.md:Whole displays"]),
    "recordings": (write_recordings, ["docs/reference/recordings.md:Recordings"]),
    "recordings-python": (write_film, ["docs/reference/recordings.md:From Python"]),
    "sessions": (write_measured, ["docs/reference/recordings.md:Sessions of the driver"]),
    "field": (
        write_calibration,
        [
            "docs/how-to/calibrate-the-field.md:Commands",
            "docs/how-to/calibrate-the-field.md:Positions to codes",
            "docs/how-to/calibrate-the-servos.md:Mirror servos",
        ],
    ),
}
DRAWINGS = {
    "docs/explanation/architecture.md": ("FrameSequence →", "core < device"),
    "docs/how-to/reach-it-from-the-network.md": ("lab.example {", "server {", "location /lab/"),
    "docs/how-to/wire-a-board.md": ("PC ── USB",),
    "docs/how-to/wire-a-scan-head.md": ("GP16 ── 1A",),
    "docs/how-to/discover-a-term.md": ("from optodrive.lab.discovery import ",),
    "docs/reference/recordings.md": ("/        ", "recording.toml   "),
}
"""Beginnings of indented blocks that are drawings, layouts of files or configurations of other programs."""
CSV_HEADER = re.compile(r"[a-z]\w*(,[a-z]\w*)+")
EVERY_TIME = ("readme", "readme-rest")
INLINE = re.compile(r"`(optodrive [^`]+)`")


def is_elsewhere(example):
    return not example.is_python and example.text.startswith(tuple(ELSEWHERE))


def select(place):
    """Return the examples below a heading that are run here."""
    page, _, heading = place.partition(":")
    found = [
        item for item in list_examples() if (item.page, item.heading) == (page, heading) and not is_elsewhere(item)
    ]
    assert found, place
    return found


def test_every_example_is_run_here_or_elsewhere():
    places = {place for _, listed in SCENARIOS.values() for place in listed}
    missing = [e for e in list_examples() if f"{e.page}:{e.heading}" not in places and not is_elsewhere(e)]
    assert missing == []
    for example in list_examples():
        if example.output and is_elsewhere(example):
            (test,) = (test for beginning, test in COMPARED_ELSEWHERE.items() if example.text.startswith(beginning))
            assert f'read_output("{example.page}"' in (ROOT / test).read_text()
    for beginning in ELSEWHERE:
        assert any(not item.is_python and item.text.startswith(beginning) for item in list_examples()), beginning


def is_data(block):
    """Return whether a block is JSON, TOML or CSV."""
    text = COMMENT.sub("", block.text.splitlines()[0])
    if CSV_HEADER.fullmatch(text):
        return True
    for read in (json.loads, tomllib.loads):
        with contextlib.suppress(ValueError):
            read(text if read is json.loads else block.text)
            return True
    return False


@pytest.mark.parametrize("block", list_blocks(), ids=lambda block: f"{block.page}:{block.line}")
def test_output_is_shown_only_where_it_is_compared(block):
    if block.language is not None:
        assert block.language in ("console", "python", "json", "toml")
        return
    first = COMMENT.sub("", block.text.splitlines()[0])
    drawings = DRAWINGS.get(block.page, ())
    assert is_command(first) or is_data(block) or block.text.startswith(drawings), "output stands in a console block"


@pytest.mark.parametrize(
    ("shown", "real"),
    [
        ("a 1\nb\n", "a 1\nb\n"),
        ("a …\n", "a 17.3 ms\n"),
        ("a … ms, b\n", "a 17.3 ms, b   \n"),
        ("…\nlast\n", "one\ntwo\nlast\n"),
        ("first\n…\n", "first\n"),
        ("a 1        # a note\n", "a 1\n"),
        ("a 1\n", "optodrive: compiling kernels, up to half a minute, once\na 1\n"),
        ("", ""),
    ],
)
def test_the_shown_output_is_the_real_one(shown, real):
    assert find_difference(shown, real) == ""


@pytest.mark.parametrize(
    ("shown", "real"),
    [
        ("a 1\n", "a 2\n"),
        ("a 1.0\n", "a 1\n"),
        ("a …\n", "a 1\nb\n"),
        ("a … b\n", "a 1\n b\n"),
        ("…\nlast\n", "one\nlast\nmore\n"),
        ("a 1 # no note\n", "a 1\n"),
        ("", "something\n"),
        ("a.c\n", "abc\n"),
    ],
)
def test_a_difference_is_found(shown, real):
    assert find_difference(shown, real)


def parse(words):
    """Parse the arguments of a command without running it."""
    command, name = typer.main.get_command(build_app()), "optodrive"
    words = name_default(command, list(words))
    parent = None
    while True:
        context = command.make_context(name, list(words), parent=parent, resilient_parsing=False)
        if not hasattr(command, "resolve_command"):
            return
        rest = [*context._protected_args, *context.args]
        name, command, words = command.resolve_command(context, rest)
        parent = context


def find_refusal(words):
    """Return why the arguments of a command are refused, '' if they are not."""
    try:
        parse(words)
    except typer.Exit:  # of --help and --version
        return ""
    except UsageError as error:
        return error.format_message()
    return ""


def read_words(text):
    """Return the arguments of a command.

    Of a synopsis, return those with all that is optional, and numbers for the values.
    """
    bare = re.sub(r"\b(POWER_MW|N)\b", "5", text.replace("[--", "--").replace("]", ""))
    return shlex.split(bare)[1:]


@pytest.mark.parametrize("example", [e for e in list_examples() if e.is_optodrive], ids=lambda e: f"{e.page}:{e.line}")
def test_the_command_and_its_options_exist(example):
    parse(read_words(example.text))


@pytest.mark.parametrize("path", list_pages(), ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_within_a_sentence_exist(path):
    for text in INLINE.findall(path.read_text()):
        if not re.search(r"[|…[]", text):
            refusal = find_refusal(read_words(text))
            assert "No such" not in refusal, (text, refusal)  # it may be named without its arguments


@pytest.mark.timeout(900)  # a page has up to a hundred commands, each of which starts an interpreter
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in EVERY_TIME else [pytest.mark.slow]) for name in SCENARIOS]
)
def test_the_examples_run_as_written(tmp_path, name):
    obstacle = find_obstacle()
    if obstacle:
        pytest.skip(obstacle)
    prepare, places = SCENARIOS[name]
    prepare(tmp_path)
    examples = [item for place in places for item in select(place)]
    run_script(write_script(examples), tmp_path)
    differences = compare_outputs(examples, tmp_path)
    assert not differences, differences
