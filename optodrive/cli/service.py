"""`optodrive service install | remove | show`: manage the files of the systemd service without starting it."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import ConfigOption, JsonOption
from optodrive.cli.output import print_answer
from optodrive.core.errors import InputError

RootOption = Annotated[
    Path, typer.Option("--root", metavar="DIR", help="Install below this folder instead of /, for packages and tests.")
]


GROUP = typer.Typer(help="Manage the files of the systemd service; no command starts it.", no_args_is_help=True)


@GROUP.command()
def install(
    config: ConfigOption = None,
    root: RootOption = Path("/"),
    program: Annotated[
        Path | None,
        typer.Option("--program", metavar="PATH", help="The optodrive executable to start; default: this one."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write unit, user, udev rules and configuration. Edited files are never overwritten."""
    from optodrive.cli.service_files import CONFIG_PATH, DEVICE_LINK, Installation, build_service_files

    installation = Installation(root)
    installed_config = installation.resolve(CONFIG_PATH)
    # An upgrade keeps the installed configuration.
    source = installed_config if config is None and installed_config.exists() else config
    started = program or Path(sys.executable).with_name("optodrive")
    if root.resolve() == Path("/") and not (started.is_file() and os.access(started, os.X_OK)):
        raise InputError("--program", str(started), "an executable file; without --root the service starts it here")
    loaded, files = build_service_files(source, started)
    actions = installation.install(files)
    if _print_files("action", actions, json):
        return
    if loaded.board.vendor_id is None and loaded.board.transport == "serial":
        print(f"no udev rules: set [board] vendor_id and product_id to get {DEVICE_LINK} and keep ModemManager away")
    elif loaded.board.transport == "serial" and loaded.board.port != DEVICE_LINK:
        print(f"[board] port is {loaded.board.port}; {DEVICE_LINK} is its persistent name")
    print(f"next, as root, once {CONFIG_PATH} is correct:")
    for line in (
        "systemd-sysusers optodrive.conf",
        "udevadm control --reload && udevadm trigger --subsystem-match=tty --subsystem-match=usb",
        "systemctl daemon-reload && systemctl enable --now optodrive",
    ):
        print(f"    {line}")
    print("The laser stays off: only `optodrive arm` arms the board, the daemon never does.")


@GROUP.command()
def remove(root: RootOption = Path("/"), json: JsonOption = False) -> None:
    """Remove the installed files, except edited ones."""
    from optodrive.cli.service_files import Installation

    actions = Installation(root).remove()
    if not _print_files("action", actions, json) and actions:
        print("stop the service if it is running: systemctl disable --now optodrive; then systemctl daemon-reload")
        print(
            "kept: /var/lib/optodrive (tokens, audit file), /var/cache/optodrive (compiled kernels), the user optodrive"
        )


@GROUP.command()
def show(root: RootOption = Path("/"), json: JsonOption = False) -> None:
    """List the installed files, and whether they were edited."""
    from optodrive.cli.service_files import Installation

    installation = Installation(root)
    statuses = [(path, str(installation.file_status(path))) for path in installation.installed_files()]
    _print_files("status", statuses, json)


def _print_files(kind: str, files: list[tuple[Path, str]], json: bool) -> bool:
    """Print the files with an action or a status each. Return whether that is all to print, as one JSON object."""
    document = {"files": [{"path": str(path), kind: text} for path, text in files]}
    print_answer(document, [f"{path}: {text}" for path, text in files] or ["nothing is installed"], json)
    return json
