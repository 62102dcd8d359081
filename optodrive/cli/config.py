"""`optodrive config new | show | check | migrate`: write, show, check or migrate a configuration."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import ConfigOption, JsonOption
from optodrive.cli.output import print_json
from optodrive.core.errors import InputError


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(help="Write, show, check or migrate a configuration.", no_args_is_help=True)
    group.command("show")(show)
    group.command("check")(check)
    group.command("migrate")(migrate)
    app.add_typer(group, name="config")


def show(config: ConfigOption = None, json: JsonOption = False) -> None:
    """Show the effective configuration with every pixel and number."""
    from optodrive.device.config_file import load_config
    from optodrive.planning.display_model import DisplayModel
    from optodrive.planning.effective_config import build_effective_config

    effective = build_effective_config(DisplayModel.from_config(load_config(config)))
    if json:
        print_json(effective)
        return
    document = effective.model_dump(mode="json")
    pixels = document["display"].pop("pixels")
    document["display"]["pixels"] = f"{len(pixels)} (listed with --json)"
    for section, content in document.items():
        if isinstance(content, dict):
            print(f"[{section}]")
            for key, value in content.items():
                print(f"{key} = {value}")
            print()
        else:
            print(f"{section} = {content}")


def check(config: ConfigOption = None, json: JsonOption = False) -> None:
    """Check a configuration file and the files that it names; the tokens only for the daemon's user."""
    from optodrive.daemon.web.tokens import read_private_tokens
    from optodrive.device.config_file import load_config
    from optodrive.planning.display_model import DisplayModel

    display = DisplayModel.from_config(load_config(config))
    tokens = display.config.daemon.tokens
    if tokens and os.access(tokens, os.R_OK):
        read_private_tokens(Path(tokens))
    if json:
        print_json({"name": display.config.name, "pixels": len(display.layout), "ok": True})
    else:
        print(f"{display.config.name}: {len(display.layout)} pixels, configuration valid")


def migrate(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Configuration of an older version.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="NEW.toml", help="Write a new file; by default to stdout.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Rename the keys of an older configuration, or list the lines that only you can change; FILE stays as it is."""
    from optodrive.core.files import atomic_write, check_output
    from optodrive.device.config_migration import migrate_config

    check_output("--out", out, ".toml")
    check_new(out)
    migration = migrate_config(file)
    if json:
        print_json(migration._asdict() | {"out": None if migration.by_hand or out is None else str(out)})
    elif migration.by_hand:
        print("\n".join(migration.by_hand))
    if migration.by_hand:
        expected = f"{len(migration.by_hand)} lines changed by hand, as listed"
        raise InputError(f"{file}: version", migration.version, expected)
    if out is not None:
        with atomic_write(out) as temporary:
            temporary.write_text(migration.text, encoding="utf-8")
    elif not json:
        print(migration.text, end="")
    if not json:
        done = ", ".join(f"renamed {each}" for each in migration.renamed) or "no key renamed"
        print(f"optodrive: version {migration.version}: {done}", file=sys.stderr)


def check_new(out: Path | None) -> None:
    """Raise InputError for a file that exists: no configuration is overwritten."""
    if out is not None and out.exists():
        raise InputError("--out", str(out), "a new file; this one exists")
