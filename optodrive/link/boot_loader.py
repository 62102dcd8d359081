"""The boot loader of a Raspberry Pi Pico: check a UF2 file, and write it to its drive or by picotool."""

import os
import shutil
import struct
import subprocess
from pathlib import Path
from typing import NamedTuple

from optodrive.core.errors import InputError, LinkError, NotReadyError, Unquoted

BLOCK = struct.Struct("<8I476sI")
MAGIC = 0x0A32_4655, 0x9E5D_5157, 0x0AB1_6F30
FLASH = 0x1000_0000
CHIPS = {0xE48B_FF56: "RP2040", 0xE48B_FF59: "RP2350"}
"""By the family of a block."""
DRIVES = {"RPI-RP2": "RP2040", "RP2350": "RP2350"}
"""By the Board-ID of a drive."""
INFO = "INFO_UF2.TXT"
MOUNTS = Path("/proc/self/mounts")
IMAGE_MAX_BYTES = 16 << 20


class Image(NamedTuple):
    """A UF2 file for one chip. size: of the flash that it fills, bytes."""

    path: Path
    content: bytes
    chip: str
    size: int


class Drive(NamedTuple):
    """The drive of a boot loader, whose chip is empty if it is not known."""

    folder: Path
    chip: str
    board_id: str


def read_image(path: Path, content: bytes) -> Image:
    """Check a UF2 file. Raise InputError unless it fills one range of the flash from its begin, for one known chip."""

    def refuse(found: str, expected: str) -> InputError:
        return InputError(str(path), Unquoted(found), expected)

    if not content or len(content) % BLOCK.size:
        raise refuse(f"{len(content)} bytes", f"blocks of {BLOCK.size}, of UF2")
    blocks = [BLOCK.unpack_from(content, at) for at in range(0, len(content), BLOCK.size)]
    families = {block[7] for block in blocks}
    for number, (first, second, _, address, size, stated, count, _, _, last) in enumerate(blocks):
        if (first, second, last) != MAGIC:
            raise refuse(f"block {number} without the marks of UF2", "its marks at begin and end")
        if (stated, count) != (number, len(blocks)):
            raise refuse(f"block {stated} of {count}", f"{number} of {len(blocks)}")
        if address != FLASH + number * size:
            raise refuse(f"block {number} for {address:#x}", f"{FLASH + number * size:#x}")
    if len(families) > 1 or not families <= set(CHIPS):
        known = ", ".join(f"{family:#x}" for family in CHIPS)
        raise refuse(f"family {', '.join(f'{family:#x}' for family in sorted(families))}", f"one of {known}")
    return Image(path, content, CHIPS[families.pop()], sum(block[4] for block in blocks))


def find_drives(mounts: Path) -> list[Drive]:
    """Return the drives of boot loaders among the mounted file systems."""
    folders = [line.split()[1].encode().decode("unicode_escape") for line in mounts.read_text().splitlines()]
    return [drive for drive in map(_read_drive, map(Path, folders)) if drive]


def _read_drive(folder: Path) -> Drive | None:
    try:
        lines = (folder / INFO).read_text(errors="replace").splitlines()
    except OSError:
        return None
    board_id = next((line.partition(":")[2].strip() for line in lines if line.startswith("Board-ID:")), "")
    return Drive(folder, DRIVES.get(board_id, ""), board_id)


def choose_drive(drives: list[Drive], image: Image) -> Drive | None:
    """Return the only drive, None if there is none. Raise NotReadyError for several, InputError for another chip's."""
    if len(drives) > 1:
        folders = ", ".join(str(drive.folder) for drive in drives)
        raise NotReadyError(f"{len(drives)} boards: {folders}; expected one: unplug the others")
    for drive in drives:
        if drive.chip != image.chip:
            expected = f"that of {image.chip}, for which {image.path} is"
            raise InputError(f"{drive.folder / INFO}: Board-ID", Unquoted(drive.board_id or "nothing"), expected)
        return drive
    return None


def copy_image(image: Image, drive: Drive) -> None:
    """Copy the file to the drive, to the last byte. The drive goes with the last block, before that is confirmed."""
    target = drive.folder / image.path.name
    try:
        with target.open("wb") as file:
            file.write(image.content)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        if _read_drive(drive.folder):
            raise LinkError(f"{target}: {error.strerror}; plug the board in again with BOOTSEL held") from None


def find_picotool() -> str:
    """Return the path of picotool. Raise NotReadyError if there is none."""
    picotool = shutil.which("picotool")
    if picotool is None:
        reason = f"no drive with {INFO} is mounted, and no picotool in PATH"
        raise NotReadyError(f"{reason}: hold BOOTSEL while plugging the board in")
    return picotool


def load_image(image: Image, picotool: str) -> None:
    """Let picotool write, verify and start the image. Raise LinkError with its output if it fails."""
    ended = subprocess.run([picotool, "load", "-v", "-x", image.path], capture_output=True, text=True, check=False)
    if ended.returncode:
        said = " ".join((ended.stdout + ended.stderr).split()) or "nothing"
        raise LinkError(f"picotool ended with {ended.returncode} and said: {said}")
