"""`optodrive config show | check`: show or check a configuration."""

import os
from pathlib import Path

import typer

from optodrive.cli.options import ConfigOption, JsonOption
from optodrive.cli.output import print_json


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(help="Show or check a configuration.", no_args_is_help=True)
    group.command("show")(show)
    group.command("check")(check)
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
