"""`optodrive patterns`: list the named patterns, or write one as frames."""

import json as json_format
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.options import ConfigOption, JsonOption
from optodrive.cli.output import print_answer
from optodrive.cli.push_options import parse_parameters
from optodrive.core.errors import MISSING, InputError

if TYPE_CHECKING:
    from optodrive.planning.stimuli.pattern import PatternDescription, PatternParameter


def patterns(
    pattern: Annotated[str | None, typer.Argument(metavar="PATTERN", help="Describe this pattern only.")] = None,
    values: Annotated[
        list[str] | None, typer.Argument(metavar="KEY=VALUE", help="Pattern parameters, for --out.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FRAMES.json", help="Write the pattern as frames and trains.")
    ] = None,
    tables: Annotated[
        str | None, typer.Option("--tables", metavar="LANGUAGE", help="List liblouis' tables of this language, or all.")
    ] = None,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """List the patterns and their parameters, or write one as a file for `plan`, `simulate` and `push`."""
    from optodrive.planning.stimuli.pattern_registry import describe_patterns, find_pattern, load_plug_ins

    if tables is not None:
        _list_tables(tables, json)
        return
    if out is not None:
        if pattern is None:
            raise InputError("PATTERN", MISSING, "the name of a pattern, for --out")
        _write_pattern(pattern, values or [], out, config, json)
        return
    if config is not None:
        raise InputError("--config", config, "--out FRAMES.json beside it; descriptions are those of every display")
    if values:
        raise InputError("--out", MISSING, f"--out FRAMES.json for {values[0]}")
    name = None if pattern is None else find_pattern(pattern).name
    descriptions = [item for item in describe_patterns() if name in (None, item.name)]
    lines = [line for item in descriptions for line in _describe(item)]
    broken = {} if name else load_plug_ins().broken
    lines += [f"{each}: cannot be used ({reason})" for each, reason in broken.items()]
    print_answer({"patterns": descriptions} | ({"broken": broken} if broken else {}), lines, json)


def _list_tables(language: str, json: bool) -> None:
    from optodrive.planning.stimuli.braille import TABLES, list_tables

    found = list_tables(language)
    if not found:
        raise InputError("--tables", language, f"all, or the code of a language of a table in {TABLES}, such as en")
    lines = [
        f"{each.table:<28} {each.language:<8} {each.dots + ' dots' if each.dots else '':<7} {each.name}"
        for each in found
    ]
    print_answer({"tables": [each._asdict() for each in found]}, lines, json)


def _write_pattern(pattern: str, values: list[str], out: Path, config: str | None, json: bool) -> None:
    from optodrive.core.files import check_output, write_text
    from optodrive.device.config_file import load_config
    from optodrive.planning.stimuli.pattern_registry import build_pattern, find_pattern
    from optodrive.planning.stimuli.sequence_file import sequence_to_json

    check_output("--out", out, ".json")
    sequence = build_pattern(pattern, parse_parameters("patterns", pattern, values), load_config(config))
    write_text(out, json_format.dumps(sequence_to_json(sequence)) + "\n")
    policy = find_pattern(pattern).policy
    counts = {"frames": len(sequence.frames), "trains": len(sequence.trains)}
    treated = "" if policy == "trim" else f"; played as a pattern its policy is {policy}: --policy {policy}"
    line = f"written          {out}: {counts['frames']} frames, {counts['trains']} trains{treated}"
    print_answer({"out": str(out), "pattern": pattern, "policy": policy, **counts}, [line], json)


def _describe(item: "PatternDescription") -> Iterator[str]:
    yield f"{item.name}: {item.summary}"
    for parameter in item.parameters:
        default = "" if parameter.default is None else f"={parameter.default}"
        yield f"    {parameter.name}{default}{_format_bounds(parameter)}  {parameter.description}"


def _format_bounds(parameter: "PatternParameter") -> str:
    if parameter.choices:
        return f" ({', '.join(parameter.choices)})"
    unit = f" {parameter.unit}" if parameter.unit else ""
    if parameter.min is None or parameter.max is None:
        return f" ({parameter.kind})"
    return f" ({parameter.min:g} to {parameter.max:g}{unit})"
