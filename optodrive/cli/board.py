"""`optodrive board settings | build | flash | emulate`: from a configuration to the firmware of a board."""

import secrets
from dataclasses import asdict
from importlib.resources import as_file
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from optodrive.cli.docs import locate_shipped_folder
from optodrive.cli.options import ConfigOption, JsonOption, StageOption
from optodrive.cli.output import print_answer

if TYPE_CHECKING:
    from optodrive.device.config import Config
    from optodrive.link.pico_firmware import PicoSettings

UID_BYTES = 12

GROUP = typer.Typer(help="Build, flash and emulate the firmware of a Raspberry Pi Pico.", no_args_is_help=True)


def _load_settings(config: str | None, stage: str | None) -> "tuple[Config, PicoSettings]":
    """Load the configuration of a stage, and build the settings of its board."""
    from optodrive.device.config_file import load_config
    from optodrive.lab.commissioning.exclusive_board import FIELD_MARGIN_M
    from optodrive.link.pico_firmware import build_pico_settings

    loaded = load_config(config).select_stage(stage)
    return loaded, build_pico_settings(loaded, FIELD_MARGIN_M, secrets.token_hex(UID_BYTES))


def _describe(config: "Config", settings: "PicoSettings") -> list[str]:
    from optodrive.link.pico_firmware import list_origins

    remark = "" if config.board.uid else ": drawn; state it as uid in [board], so that no other board is accepted"
    measured = f", measured within {settings.feedback_codes} codes" if settings.feedback_codes else ""
    return [
        f"{'uid':<17}{settings.uid}{remark}",
        f"{'gate':<17}PWM at {settings.gate_hz} Hz",
        f"{'mirrors':<17}{settings.interface}{measured}",
        *(f"{name:<17}{origin}" for name, origin in list_origins(config).items()),
    ]


@GROUP.command()
def settings(
    config: ConfigOption = None,
    stage: StageOption = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="settings.h", help="File to write.")] = None,
    json: JsonOption = False,
) -> None:
    """Write the settings of the board: the limits that its display requires, which no host can loosen."""
    from optodrive.core.files import check_output, write_text

    check_output("--out", out, ".h")
    loaded, built = _load_settings(config, stage)
    document = built._asdict() | {"limits": asdict(built.limits)}
    if out is None:
        lines = [built.to_header(loaded.name)]
    else:
        write_text(out, built.to_header(loaded.name))
        lines = [f"{'written':<17}{out}", *_describe(loaded, built)]
    print_answer(document, lines, json)


@GROUP.command()
def build(
    out: Annotated[Path, typer.Argument(metavar="FILE.uf2", help="Image to write; no file is overwritten.")],
    config: ConfigOption = None,
    stage: StageOption = None,
    chip: Annotated[
        Literal["rp2040", "rp2350"], typer.Option("--chip", help="rp2040: Pico; rp2350: Pico 2, which nothing has run.")
    ] = "rp2040",
    json: JsonOption = False,
) -> None:
    """Build the firmware's image for the configuration. It needs Debian's gcc-arm-none-eabi and make."""
    from optodrive.core.files import atomic_write, check_output
    from optodrive.link.pico_firmware import build_image

    check_output("FILE", out, ".uf2")
    loaded, built = _load_settings(config, stage)
    with as_file(locate_shipped_folder("firmware_protocol")) as firmware:
        image = build_image(firmware, built.to_header(loaded.name), chip)
    with atomic_write(out) as path:
        path.write_bytes(image)
    document = {"out": str(out), "chip": chip, "uid": built.uid}
    next_line = f"{'next':<17}optodrive board flash {out}"
    print_answer(document, [f"{'written':<17}{out}: {chip}", *_describe(loaded, built), next_line], json)


@GROUP.command()
def flash(
    file: Annotated[Path, typer.Argument(metavar="FILE.uf2", help="Image, as `optodrive board build` writes it.")],
    json: JsonOption = False,
) -> None:
    """Write an image to a Pico that was plugged in with BOOTSEL held. Switch the laser's supply off before."""
    from optodrive.core.files import read_bounded
    from optodrive.link import boot_loader

    image = boot_loader.read_image(file, read_bounded(file, boot_loader.IMAGE_MAX_BYTES))
    drive = boot_loader.choose_drive(boot_loader.find_drives(boot_loader.MOUNTS), image)
    if drive:
        boot_loader.copy_image(image, drive)
        way = f"{drive.folder}: {drive.chip}, Board-ID {drive.board_id}"
    else:
        picotool = boot_loader.find_picotool()
        boot_loader.load_image(image, picotool)
        way = f"by {picotool}"
    document = {"image": str(file), "chip": image.chip, "bytes": image.size, "board": way}
    lines = [
        f"{'image':<17}{file}: {image.chip}, {image.size} bytes of flash from {boot_loader.FLASH:#x}",
        f"{'board':<17}{way}; it starts with the image",
        f"{'next':<17}optodrive doctor --board PORT, which never arms",
    ]
    print_answer(document, lines, json)


@GROUP.command()
def emulate(
    file: Annotated[Path, typer.Argument(metavar="FILE.uf2", help="Image, as `optodrive board build` writes it.")],
    port: Annotated[
        Path, typer.Option("--port", metavar="LINK", help="Link to create: board.port of the configuration.")
    ],
    log: Annotated[
        Path | None,
        typer.Option("--log", metavar="pins.jsonl", help="Write edges of the gate and moves of the mirrors."),
    ] = None,
    modules: Annotated[
        Path, typer.Option("--modules", metavar="FOLDER", help="Folder in which npm has installed rp2040js.")
    ] = Path("~/.local/share/optodrive"),
) -> None:
    """Run an image in an emulator of the Pico's chip, with a port to which `optodrive serve` connects."""
    import json as lines
    import signal
    from contextlib import ExitStack

    from optodrive.core.files import check_output, read_bounded
    from optodrive.link import boot_loader
    from optodrive.link.simulator.emulated_pico import EmulatedPico, find_modules

    check_output("--log", log, ".jsonl")
    image = boot_loader.read_image(file, read_bounded(file, boot_loader.IMAGE_MAX_BYTES))
    emulator = find_modules(modules.expanduser().absolute())
    with ExitStack() as stack:
        firmware = stack.enter_context(as_file(locate_shipped_folder("firmware_protocol")))
        written = None if log is None else stack.enter_context(log.open("w", buffering=1))

        def write_event(event: dict[str, object]) -> None:
            if written is not None:
                written.write(lines.dumps(event) + "\n")

        pico = stack.enter_context(EmulatedPico(image, firmware, emulator, port.absolute(), write_event))
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: pico.stop())
        print(f"{'port':<17}{port}: the USB port of a Pico with {file}, in the chip's own, slower time")
        environment = f"export BOARD_TIME={pico.time_file} LD_PRELOAD={pico.library}"
        print(f"{'next':<17}in another terminal: {environment}; optodrive serve --config my.toml", flush=True)
        pico.run()
