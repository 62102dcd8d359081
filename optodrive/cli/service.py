"""`optodrive service install | remove | show`: manage the files of the systemd service without starting it."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import ConfigOption, JsonOption
from optodrive.cli.output import print_answer
from optodrive.core.errors import InputError

RootOption = Annotated[
    Path, typer.Option("--root", metavar="DIR", help="Install below this folder instead of /, for packages and tests.")
]

NameOption = Annotated[
    str | None,
    typer.Option("--name", metavar="NAME", help="Of a further service on this host, the unit optodrive@NAME."),
]

GROUP = typer.Typer(help="Manage the files of the systemd service; no command starts it.", no_args_is_help=True)


@GROUP.command()
def install(
    config: ConfigOption = None,
    name: NameOption = None,
    root: RootOption = Path("/"),
    program: Annotated[
        Path | None,
        typer.Option("--program", metavar="PATH", help="The optodrive executable to start; default: this one."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write unit, user, udev rules and configuration. Edited files are never overwritten."""
    from optodrive.cli.service_files import (
        Installation,
        ServicePaths,
        build_service_files,
        check_other_services,
        find_device_class,
        list_serial_ports,
    )

    paths = ServicePaths.from_option(name)
    installation = Installation(root, paths)
    installed_config = installation.resolve(paths.config)
    # An upgrade keeps the installed configuration.
    source = installed_config if config is None and installed_config.exists() else config
    started = program or Path(sys.executable).with_name("optodrive")
    if root.resolve() == Path("/") and not (started.is_file() and os.access(started, os.X_OK)):
        raise InputError("--program", str(started), "an executable file; without --root the service starts it here")
    loaded, files = build_service_files(source, started, paths)
    check_other_services(root, paths, loaded, config is not None)
    actions = installation.install(files)
    if _print_files("action", actions, json):
        return
    for key, port in list_serial_ports(loaded):
        if find_device_class(port) is None:
            print(f"warning: {key} = {port} is not present: the unit allows it only if it is on USB")
    if loaded.board.vendor_id is None and loaded.board.transport == "serial":
        print(
            f"no udev rules: set [board] vendor_id and product_id to get {paths.device_link} and keep ModemManager away"
        )
    elif loaded.board.transport == "serial" and loaded.board.port != paths.device_link:
        print(f"[board] port is {loaded.board.port}; {paths.device_link} is its persistent name")
    print(f"next, as root, once {paths.config} is correct:")
    for line in (
        f"systemd-sysusers {paths.users.name}",
        "udevadm control --reload && udevadm trigger --subsystem-match=tty --subsystem-match=usb",
        f"systemctl daemon-reload && systemctl enable --now {paths.unit_name}",
    ):
        print(f"    {line}")
    print("The laser stays off: only `optodrive arm` arms the board, the daemon never does.")


@GROUP.command()
def remove(name: NameOption = None, root: RootOption = Path("/"), json: JsonOption = False) -> None:
    """Remove the installed files, except edited ones."""
    from optodrive.cli.service_files import Installation, ServicePaths, list_units

    paths = ServicePaths.from_option(name)
    actions = Installation(root, paths).remove()
    if not _print_files("action", actions, json, list_units(root)) and actions:
        unit = paths.unit_name
        print(f"stop the service if it is running: systemctl disable --now {unit}; then systemctl daemon-reload")
        if (paths.rules, "removed") in actions:
            print("then udevadm control --reload")
        kept = f"/var/lib/{paths.program} (tokens, audit file), /var/cache/optodrive (compiled kernels)"
        print(f"kept: {kept}, the user optodrive")


@GROUP.command()
def show(name: NameOption = None, root: RootOption = Path("/"), json: JsonOption = False) -> None:
    """List the installed files, and whether they were edited."""
    from optodrive.cli.service_files import Installation, ServicePaths, list_units

    installation = Installation(root, ServicePaths.from_option(name))
    statuses = [(path, str(installation.file_status(path))) for path in installation.installed_files()]
    _print_files("status", statuses, json, list_units(root))


def _print_files(kind: str, files: list[tuple[Path, str]], json: bool, units: Sequence[str] = ()) -> bool:
    """Print the files with an action or a status each. Return whether that is all to print, as one JSON object.

    units: of the services that are installed; they are named where there is no file
    """
    document = {"files": [{"path": str(path), kind: text} for path, text in files]}
    others = f" of this name; there is {', '.join(units)}" if units else ""
    print_answer(document, [f"{path}: {text}" for path, text in files] or [f"nothing is installed{others}"], json)
    return json
