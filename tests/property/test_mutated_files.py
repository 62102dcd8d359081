"""A damaged TOML file of any format is read, or refused in one line that names the file: never another error."""

import re
from collections import Counter

import numpy as np
import pytest

from optodrive.cli.options import load_run_config
from optodrive.core.errors import InputError
from optodrive.daemon.api.tokens import create_tokens, read_private_tokens
from optodrive.device.config_file import list_shipped_configs, locate_shipped
from optodrive.lab.calibration.pictures import read_picture_folder
from optodrive.link.simulator.guards import load_settings
from optodrive.link.simulator.script import load_script
from optodrive.planning.display_model import DisplayModel
from sound_files import FieldFile, Mirrors, Parameters, Pictures, Pixels, write_toml

LINE_MAX = 1000
NUMBER = re.compile(r"-?\b[0-9]{1,20}(?:\.[0-9]+)?(?:e-?[0-9]+)?\b")
SECTIONS = re.compile(r"(?:pixel_model|scanner|limits|panel|stages|terms)\.")
"""Begin of a refusal by what a configuration and the files that it names are together."""
VALUES = (
    *("true", "-0.0", "0", "-1", "3", "1e308", "-1e308", "1e-320", "nan", "inf", "-inf", "1e400"),
    *("1" * 5000, "0x" + "f" * 5000, "9223372036854775807", "-9223372036854775808", "9" * 19, "1." + "1" * 5000),
    *('""', '"4"', '"a.toml"', '"a\\u0000b"', '"\\u001b[2J\\n\\u0007"', f'"{"x" * 100_000}"', '"/dev/zero"', '"../.."'),
    *("[" * 3000, "[" * 30 + "]" * 30, "[]", "{}", "[[[1]]]", '[1, "a"]', "[0, 99]", "{ a = { b = 1 } }"),
    *("2026-11-24", "07:32:00", "2026-13-45T25:00:00Z", "4 4", "="),
)
LINES = (
    ".".join("a" * 5000) + " = 1",
    f"[{'.'.join('a' * 50_000)}]",
    f"{'k' * 100_000} = 1",
    '"\\u001b[31m\\n" = 1',
    "[[daemon]]",
    "[display]",
    "terms = 3",
    "stages = [1]",
    "[[stages]]",
    "[stages.scanner]",
    'base = "../parameters/calibrated"',
)


def read_config(path):
    DisplayModel.from_config(load_run_config(str(path), None))


def read_with(option):
    """Return the reader of a file that an option of `serve` names."""
    return lambda path: DisplayModel.from_config(load_run_config("display-16", **{"model": None, option: path}))


def list_files(folder):
    """Return sound files as (name, content, reader), each in a folder of its own."""
    rng = np.random.default_rng(20)
    files = [
        (f"{name}.toml", locate_shipped(f"{name}.toml").read_text(), read_config) for name in list_shipped_configs()
    ]
    sets = locate_shipped("parameters").glob("*.toml")
    files += [(path.name, path.read_text(), read_with("model")) for path in sorted(sets)]
    drawn = {"model": Parameters(), "mirrors": Mirrors(), "field": FieldFile(), "pixel_map": Pixels()}
    for option, item in drawn.items():
        text = write_toml(folder / "drawn.toml", item.draw(rng)).read_text()
        files.append((f"{item.name}.toml", text, read_with(option)))
    text = write_toml(folder / "drawn.toml", Pictures().draw(rng)).read_text()
    files.append(("pictures.toml", text, lambda path: read_picture_folder(path.parent)))
    create_tokens(folder / "tokens.toml")
    files.append(("tokens.toml", (folder / "tokens.toml").read_text(), read_private_tokens))
    files.append(("script.toml", '[[step]]\nat_s = 1.0\ndo = "flip_bits"\nrate = 0.1\n', load_script))
    files.append(("limits.toml", 'max_on_us = 20000\nuid = "73696d756c61746564303031"\n', load_settings))
    for name in ("grid.png", "spot_32768_32768.png"):
        (folder / name).touch()
    return files


def mutate(rng, text):
    """Return a text with one or two damages: values, lines, characters, or one number by a factor."""
    for _ in range(int(rng.integers(1, 3))):
        lines = text.split("\n")
        at = int(rng.integers(len(lines)))
        key, equals, _ = lines[at].partition("=")
        kind = int(rng.integers(10))
        if kind <= 2 and equals:
            lines[at] = f"{key}= {rng.choice(VALUES)}"
        elif kind >= 8:
            factor = float(rng.choice([-1.0, 0.0, 10 ** rng.uniform(-9.0, 9.0), rng.uniform(0.3, 3.0)]))
            numbers = list(NUMBER.finditer(lines[at]))
            if numbers:
                number = numbers[int(rng.integers(len(numbers)))]
                changed = (
                    repr(float(number[0]) * factor)
                    if set(number[0]) & set(".e")
                    else str(round(int(number[0]) * factor))
                )
                lines[at] = lines[at][: number.start()] + changed + lines[at][number.end() :]
        elif kind == 3:
            lines.insert(at, str(rng.choice(LINES)))
        elif kind == 4:
            del lines[at]
        elif kind == 5:
            lines.insert(int(rng.integers(len(lines))), lines[at])
        elif kind == 6:
            lines[at] = lines[at][: int(rng.integers(len(lines[at]) + 1))]
        else:
            cut = int(rng.integers(len(lines[at]) + 1))
            lines[at] = (
                lines[at][:cut] + str(rng.choice(list("\0\x1b\"'[]{}=.,#\r\ufeff\U0001f4a5-9"))) + lines[at][cut:]
            )
        text = "\n".join(lines)
    return text


@pytest.mark.parametrize("count", [25, pytest.param(300, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])])
def test_damaged_files_are_refused_in_one_line(count, tmp_path):
    outcomes, wrong = Counter(), []
    for number, (name, sound, read) in enumerate(list_files(tmp_path)):
        path = tmp_path / name
        path.touch(mode=0o600)
        path.write_text(sound, encoding="utf-8")
        read(path)
        for seed in range(count):
            damaged = mutate(np.random.default_rng([count, number, seed]), sound)
            path.write_text(damaged, encoding="utf-8", errors="surrogatepass")
            try:
                read(path)
                outcomes["read"] += 1
            except InputError as error:
                outcomes["refused"] += 1
                message = str(error)
                if not (
                    message.isprintable() and len(message) <= LINE_MAX and (name in message or SECTIONS.match(message))
                ):
                    wrong.append((name, seed, message[:LINE_MAX]))
            except Exception as error:
                wrong.append((name, seed, repr(error)[:LINE_MAX]))
    print(f"{outcomes['read']} read, {outcomes['refused']} refused, {len(wrong)} wrong")
    assert not wrong, "\n".join(f"{name} {seed}: {message[:300]}" for name, seed, message in wrong)
    assert min(outcomes["read"], outcomes["refused"]) > count, outcomes


@pytest.mark.parametrize(("key", "value"), [("focal_length_m", -0.0), ("focal_length_m", 1e-200)])
def test_a_field_whose_codes_have_no_position_is_refused(key, value, tmp_path):
    content = FieldFile().draw(np.random.default_rng(1))
    content["geometry"][key] = value
    path = write_toml(tmp_path / "field.toml", content)
    with pytest.raises(InputError, match=r"field\.toml: geometry"):
        read_with("field")(path)
