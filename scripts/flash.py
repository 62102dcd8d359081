"""Write a UF2 file to a Raspberry Pi Pico in its boot loader: to the drive that it shows, else by picotool.

python scripts/flash.py [FILE.uf2]: states file and board before it writes. Needs nothing but Python.
"""

import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

DEFAULT = Path(__file__).parents[1] / "firmware_protocol" / "ports" / "rp2040" / "build" / "board.uf2"
BLOCK = struct.Struct("<8I476sI")
MAGIC = 0x0A32_4655, 0x9E5D_5157, 0x0AB1_6F30
FLASH = 0x1000_0000
CHIPS = {0xE48B_FF56: "RP2040", 0xE48B_FF59: "RP2350"}
"""By the family of a block."""
DRIVES = {"RPI-RP2": "RP2040", "RP2350": "RP2350"}
"""By the Board-ID of a drive."""
INFO = "INFO_UF2.TXT"
MOUNTS = Path("/proc/self/mounts")


class FlashError(Exception):
    """What cannot be written, in one line."""


class Image(NamedTuple):
    """A UF2 file: what it holds, and for which chip."""

    path: Path
    chip: str
    size: int


class Drive(NamedTuple):
    """The drive of a boot loader."""

    folder: Path
    chip: str
    board_id: str


def read_image(path):
    """Check a UF2 file. Raise FlashError unless it fills one range of the flash from its begin, for one known chip."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FlashError(
            f"{path}: {error.strerror}, expected a UF2 file; make builds it in {DEFAULT.parents[1]}"
        ) from None
    if not content or len(content) % BLOCK.size:
        raise FlashError(f"{path}: {len(content)} bytes, expected blocks of {BLOCK.size}")
    blocks = [BLOCK.unpack_from(content, at) for at in range(0, len(content), BLOCK.size)]
    families = {block[7] for block in blocks}
    for number, block in enumerate(blocks):
        first, second, _, address, size, stated, count, _, _, last = block
        if (first, second, last) != MAGIC:
            raise FlashError(f"{path}: block {number} does not begin and end like one of UF2")
        if (stated, count) != (number, len(blocks)):
            raise FlashError(f"{path}: block {number} says {stated} of {count}, expected {number} of {len(blocks)}")
        if address != FLASH + number * size:
            raise FlashError(f"{path}: block {number} is for {address:#x}, expected {FLASH + number * size:#x}")
    if len(families) > 1 or not families <= set(CHIPS):
        given = ", ".join(f"{family:#x}" for family in sorted(families))
        raise FlashError(f"{path}: family {given}, expected one of {', '.join(f'{known:#x}' for known in CHIPS)}")
    return Image(path, CHIPS[families.pop()], sum(block[4] for block in blocks))


def read_drive(folder):
    """Return the boot loader's drive in a folder, None if it is none."""
    try:
        lines = (folder / INFO).read_text(errors="replace").splitlines()
    except OSError:
        return None
    board_id = next((line.partition(":")[2].strip() for line in lines if line.startswith("Board-ID:")), "")
    return Drive(folder, DRIVES.get(board_id, ""), board_id)


def find_drives(mounts):
    """Return the drives of boot loaders among the mounted file systems."""
    folders = [line.split()[1].encode().decode("unicode_escape") for line in mounts.read_text().splitlines()]
    return [drive for drive in map(read_drive, map(Path, folders)) if drive]


def choose_drive(drives, image):
    """Return the only drive, None if there is none. Raise FlashError for several, or one of another chip."""
    if len(drives) > 1:
        raise FlashError(
            f"{len(drives)} boards: {', '.join(str(drive.folder) for drive in drives)}; expected one: unplug the others"
        )
    for drive in drives:
        if drive.chip != image.chip:
            found = drive.board_id or "nothing"
            raise FlashError(
                f"{drive.folder / INFO}: Board-ID {found}, expected that of {image.chip}, for which {image.path} is"
            )
        return drive
    return None


def copy(image, drive):
    """Copy the file to the drive, to the last byte. The drive goes with the last block, before that is confirmed."""
    target = drive.folder / image.path.name
    try:
        with target.open("wb") as file:
            file.write(image.path.read_bytes())
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        if read_drive(drive.folder):
            raise FlashError(f"{target}: {error.strerror}; plug the board in again with BOOTSEL held") from None


def load(image, picotool):
    """Let picotool write, verify and start the image."""
    ended = subprocess.run([picotool, "load", "-v", "-x", image.path], capture_output=True, text=True)
    if ended.returncode:
        said = " ".join((ended.stdout + ended.stderr).split()) or "nothing"
        raise FlashError(f"picotool ended with {ended.returncode} and said: {said}")


def flash(path, mounts):
    """Write a UF2 file to the board in its boot loader."""
    image = read_image(path)
    print(f"image  {image.path}: {image.chip}, {image.size} bytes of flash from {FLASH:#x}")
    drive, picotool = choose_drive(find_drives(mounts), image), shutil.which("picotool")
    if drive:
        print(f"board  {drive.folder}: {drive.chip}, Board-ID {drive.board_id}; copying the image there")
        copy(image, drive)
    elif picotool:
        print(f"board  no drive with {INFO}; {picotool} looks for one and writes the image")
        load(image, picotool)
    else:
        raise FlashError(
            f"no drive with {INFO} is mounted, and no picotool in PATH: hold BOOTSEL while plugging the board in"
        )
    print("done   the board starts with it; optodrive doctor --board PORT examines it without arming")


def main(arguments, mounts=MOUNTS):
    """Return the exit status: 0 if it is written, 2 with one line on stderr if not."""
    if len(arguments) > 1 or arguments[:1] == ["--help"]:
        print(f"usage: scripts/flash [FILE.uf2]; without one, {DEFAULT}")
        return 0 if arguments == ["--help"] else 2
    try:
        flash(Path(arguments[0]) if arguments else DEFAULT, mounts)
    except FlashError as error:
        sys.stderr.write(f"scripts/flash: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
