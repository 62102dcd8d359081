"""Files of a caller are bounded by counts before the work that they cause, and what is within takes linear work."""

import struct
import tracemalloc
from contextlib import suppress
from io import BytesIO
from zlib import compress, crc32

import pytest
from PIL import Image

from executed_lines import count_lines
from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config
from optodrive.planning.stimuli import braille_files, images, text
from optodrive.planning.stimuli.braille import encode_word
from optodrive.planning.stimuli.braille_files import CHARACTERS_MAX, TAGS_MAX, _read_pef
from optodrive.planning.stimuli.pattern_registry import build_pattern
from optodrive.planning.stimuli.sequence_file import FRAMES_MAX
from optodrive.planning.stimuli.text import PAGES_MAX, wrap_words

CONFIG = load_config("display-437")
PEF = '<pef xmlns="http://www.daisy.org/ns/2008/pef"><body>{}</body></pef>'


def _never(*_, **__):
    raise AssertionError("work that the bound must come before")


def _repeat_scan(passes):
    """Return a progressive JPEG whose last pass stands many times: small, and as much work as many pictures."""
    buffer = BytesIO()
    Image.linear_gradient("L").save(buffer, "JPEG", progressive=True)
    file = buffer.getvalue()
    last = file.rindex(images.SCAN_MARK)
    return file[:last] + (passes - file.count(images.SCAN_MARK) + 1) * file[last:-2] + file[-2:]


def _claim_size(width, height):
    """Return a PNG of a few bytes that claims a size."""
    buffer = BytesIO()
    Image.new("L", (8, 8), 255).save(buffer, "PNG")
    file = bytearray(buffer.getvalue())
    file[16:24] = struct.pack(">II", width, height)
    file[29:33] = struct.pack(">I", crc32(file[12:29]))
    return bytes(file)


def _expand(kind, content):
    """Return a PNG of 8 × 8 samples with a chunk of compressed content."""
    file, chunk = _claim_size(8, 8), kind + content + compress(bytes(100_000_000), 9)
    return file[:33] + struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", crc32(chunk)) + file[33:]


def _animate(count):
    pictures = [Image.new("L", (1000, 1000), 200 + k % 50) for k in range(count)]
    buffer = BytesIO()
    pictures[0].save(buffer, "GIF", save_all=True, append_images=pictures[1:])
    return buffer.getvalue()


TOO_MUCH = {
    "pixels of a PNG": ("image", _claim_size(5000, 4000), "5000 × 4000"),
    "a side of a PNG": ("image", _claim_size(20_001, 1), "20001 × 1"),
    "passes of a JPEG": ("image", _repeat_scan(images.SCANS_MAX + 1), "a JPEG of 101 passes"),
    "pixels of an animation": ("animation", _animate(65), "65 pictures of 1000 × 1000"),
    "bytes of braille": ("braille-file", b"A" * (4 * CHARACTERS_MAX + 1), "2000001 bytes"),
    "characters of braille": ("braille-file", b"A" * (CHARACTERS_MAX + 1), "500001 characters, 1 pages"),
    "pages of braille": ("braille-file", b"A" + b"\f" * PAGES_MAX, "3001 pages"),
    "rows of braille": ("braille-file", b"A\n" * (6 * PAGES_MAX), "more than 3000 pages of display-437"),
    "cells of braille": ("braille-file", b"A" * (50 * PAGES_MAX), "more than 3000 pages of display-437"),
    "tags of a PEF": ("braille-file", PEF.format("<page/>" * TAGS_MAX).encode(), "100004 tags"),
}


@pytest.mark.parametrize("case", TOO_MUCH)
def test_too_much_is_refused_before_the_work(monkeypatch, case):
    pattern, file, found = TOO_MUCH[case]
    for module, work in ((images, "_compute_brightness"), (text, "hold_picture"), (braille_files, "fromstring")):
        monkeypatch.setattr(module, work, _never)
    with pytest.raises(InputError) as refused:
        build_pattern(pattern, {"file": file}, CONFIG)
    assert refused.value.code == "too_many"
    assert found in str(refused.value)


@pytest.mark.parametrize("chunk", [(b"zTXt", b"a\0\0"), (b"iTXt", b"a\0\1\0\0\0"), (b"iCCP", b"a\0\0"), (b"IDAT", b"")])
def test_what_expands_in_a_picture_is_not_expanded(chunk):
    """Of the hundred megabytes in a hundred kilobytes, no more are read than the picture needs."""
    file = _expand(*chunk)
    tracemalloc.start()
    try:
        with suppress(InputError):
            build_pattern("image", {"file": file}, CONFIG)
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()


def test_a_picture_within_the_bounds_is_shown():
    assert build_pattern("image", {"file": _repeat_scan(images.SCANS_MAX)}, CONFIG).frames


def test_long_pages_end_at_the_largest_number_of_frames(monkeypatch):
    """A page for ten minutes has thousands of frames: only those of the first pages are built."""
    held, hold = [], text.hold_picture
    monkeypatch.setattr(text, "hold_picture", lambda *given: held.append(hold(*given)) or held[-1])
    with pytest.raises(InputError, match="100 pages for 600 s each, expected pages that take at most 10000 frames"):
        build_pattern("braille-file", {"file": b"A\f" * 100, "seconds": 600}, CONFIG)
    assert sum(map(len, held[:-1])) <= FRAMES_MAX


class CountedWord(list):
    """A word that counts the cells that are copied from it."""

    copied = 0

    def __getitem__(self, at):
        part = super().__getitem__(at)
        if isinstance(at, slice):
            CountedWord.copied += len(part)
            return CountedWord(part)
        return part


def test_a_long_word_is_copied_once():
    CountedWord.copied = 0
    word = CountedWord([frozenset({1})] * 10_000)
    rows = wrap_words([[word]], [7, 5])
    assert sum(map(len, rows)) == 10_000
    assert CountedWord.copied == 10_000


@pytest.mark.parametrize("word", ["A", "a", "Aa", "1.", "A1", ".1"])
def test_the_work_of_a_word_grows_with_its_length(word):
    short, long = (count_lines(lambda n=n: encode_word(word * n)) for n in (200, 400))
    assert long <= 2.2 * short


def test_pages_within_pages_are_read_once():
    rows = [f"<page><row>{chr(0x2800 + k)}</row>" for k in range(1, 30)]
    nested = PEF.format("".join(rows) + "</page>" * len(rows))
    assert _read_pef(nested.encode(), "t") == [[chr(0x2800 + k)] for k in range(1, 30)]
    with pytest.raises(InputError, match="cells alone in a row"):
        _read_pef(PEF.format("<page><row>\u2801<row>\u2802</row></row></page>").encode(), "t")
