"""Fit, brightness, durations and refusal of images and animations."""

import struct
import subprocess
import sys
from io import BytesIO

import numpy as np
import pytest
from PIL import Image, ImageDraw, PngImagePlugin

from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config
from optodrive.planning.stimuli import images
from optodrive.planning.stimuli.images import build_animation, build_image, compute_lattice_brightness
from optodrive.planning.stimuli.pixel_lattice import Lattice

CONFIG = load_config("display-437")
LATTICE = Lattice.from_config(CONFIG)


def encoded(*pictures, kind="PNG", **options):
    buffer = BytesIO()
    extra = {"save_all": True, "append_images": pictures[1:]} if len(pictures) > 1 else {}
    pictures[0].save(buffer, kind, **extra, **options)
    return buffer.getvalue()


def grey(array):
    return Image.fromarray(np.asarray(array, dtype=np.uint8))


def shown(file, invert=False):
    """Return the brightness at every place, [rows from the top, columns], NaN in the corners."""
    target = build_image(CONFIG, "t", file, 1.0, 0.0, invert).frames[0].target_m
    return np.where(LATTICE.index >= 0, target[LATTICE.index], np.nan)[::-1]


def test_left_is_left_and_top_is_top():
    values = np.zeros((21, 21))
    values[1, 5] = 255
    place = np.argwhere(shown(encoded(grey(values))) > 0)
    assert place.tolist() == [[1, 5]]
    (pixel,) = np.flatnonzero(build_image(CONFIG, "t", encoded(grey(values)), 1.0, 0.0, False).frames[0].target_m)
    assert LATTICE.layout.x_m[pixel] == pytest.approx(-5 * 3.6e-3)
    assert LATTICE.layout.y_m[pixel] == pytest.approx(9 * 3.6e-3)


def test_brightness_is_averaged_over_the_area_of_a_place():
    fine = np.random.default_rng(2).integers(50, 256, (63, 63))
    expected = fine.reshape(21, 3, 21, 3).mean(axis=(1, 3)) / 255
    found = shown(encoded(grey(fine)))
    assert np.count_nonzero(np.isnan(found)) == 4
    assert np.nanmax(np.abs(found - expected)) < 1e-5


@pytest.mark.parametrize(("size", "rows", "columns"), [((42, 14), 7, 21), ((14, 42), 21, 7), ((1, 1), 21, 21)])
def test_the_aspect_ratio_is_preserved_and_the_image_centred(size, rows, columns):
    bright = np.nan_to_num(shown(encoded(Image.new("L", size, 255))), nan=1.0) > 0.5
    found_rows, found_columns = np.flatnonzero(bright[:, 10]), np.flatnonzero(bright[10])
    assert (len(found_rows), len(found_columns)) == (rows, columns)
    assert found_rows.mean() == found_columns.mean() == 10


def test_invert_raises_dark_areas_but_not_the_border():
    picture = Image.new("L", (42, 14), 0)
    assert refusal(encoded(picture))[0] == "raises_nothing"
    assert np.nansum(shown(encoded(picture), invert=True)) == pytest.approx(7 * 21, rel=1e-6)


def test_transparency_is_dark_inverted_or_not():
    picture = Image.new("RGBA", (21, 21), (255, 255, 255, 0))
    picture.paste((255, 255, 255, 128), (0, 0, 21, 10))
    found = shown(encoded(picture))
    assert found[5, 5] == pytest.approx(128 / 255, abs=1e-5)
    assert found[15, 5] == 0
    picture.paste((0, 0, 0, 255), (0, 0, 5, 21))
    assert shown(encoded(picture), invert=True)[15, 2] == 1.0
    assert shown(encoded(picture), invert=True)[15, 10] == 0


@pytest.mark.parametrize(
    ("picture", "value"),
    [
        (Image.new("RGB", (9, 9), (255, 0, 0)), 76 / 255),
        (Image.new("1", (9, 9), 1), 1.0),
        (Image.new("L", (9, 9), 9 * 12).convert("P"), 108 / 255),
        (Image.new("LA", (9, 9), (200, 255)), 200 / 255),
        (Image.fromarray(np.full((9, 9), 32768, dtype=np.uint16)), 0.5),
    ],
)
def test_every_mode_is_read(picture, value):
    assert shown(encoded(picture))[10, 10] == pytest.approx(value, abs=1e-4)


def test_jpeg_is_read_upright():
    picture = Image.new("L", (40, 40), 0)
    picture.paste(255, (0, 0, 40, 20))
    exif = Image.Exif()
    exif[0x0112] = 3  # the camera was held upside down
    assert shown(encoded(picture, kind="JPEG"))[3, 10] == pytest.approx(1.0, abs=0.01)
    turned = shown(encoded(picture, kind="JPEG", exif=exif))
    assert turned[3, 10] == 0
    assert turned[17, 10] == pytest.approx(1.0, abs=0.01)


def test_nearly_black_is_not_driven():
    assert refusal(encoded(Image.new("L", (9, 9), 9)))[0] == "raises_nothing"
    assert build_image(CONFIG, "t", encoded(Image.new("L", (9, 9), 12)), 1.0, 0.0, False).frames[0].target_m.all()


def dots(count):
    pictures = [Image.new("L", (21, 21), 0) for _ in range(count)]
    for k, picture in enumerate(pictures):
        picture.putpixel((5 + k, 10), 255)
    return pictures


@pytest.mark.parametrize("kind", ["GIF", "PNG"])
def test_an_animation_uses_the_durations_of_its_file(kind):
    file = encoded(*dots(4), kind=kind, duration=[50, 120, 10, 80], **({"disposal": 2} if kind == "GIF" else {}))
    frames = build_animation(CONFIG, "t", file, 50e-6, None, False).frames
    assert [frame.duration_s for frame in frames] == pytest.approx([0.05, 0.12, 0.02, 0.08])
    assert [frame.show_at_s for frame in frames] == pytest.approx([0.0, 0.05, 0.17, 0.19])
    assert [np.flatnonzero(frame.target_m).tolist() for frame in frames] == [
        [int(LATTICE.index[10, 5 + k])] for k in range(4)
    ]


def test_an_image_lasts_for_its_beam_time_unless_a_rate_is_given():
    file = encoded(Image.new("L", (21, 21), 255), *dots(1), kind="GIF", duration=50)
    slow = build_animation(CONFIG, "t", file, 50e-6, None, False).frames
    assert slow[0].duration_s > 437 * 3e-3
    assert slow[1].duration_s == pytest.approx(0.05)
    assert slow[1].show_at_s == slow[0].duration_s
    fast = build_animation(CONFIG, "t", file, 50e-6, 25.0, False).frames
    assert [frame.show_at_s for frame in fast] == pytest.approx([0.0, 0.04])


def test_the_default_image_of_a_png_is_not_part_of_its_animation():
    poster, *moving = dots(4)
    file = encoded(poster, *moving, default_image=True, duration=100)
    frames = build_animation(CONFIG, "t", file, 50e-6, None, False).frames
    assert [np.flatnonzero(frame.target_m).tolist() for frame in frames] == [
        [int(LATTICE.index[10, 5 + k])] for k in (1, 2, 3)
    ]


@pytest.mark.parametrize("text", ["nan", "abc", "1e999", "-5"])
def test_a_text_chunk_named_duration_is_ignored(text):
    notes = PngImagePlugin.PngInfo()
    notes.add_text("duration", text)
    (frame,) = build_animation(CONFIG, "t", encoded(*dots(1), pnginfo=notes), 50e-6, None, False).frames
    assert frame.duration_s == pytest.approx(0.1)


def refusal(file, build=build_image):
    with pytest.raises(InputError) as caught:
        build(CONFIG, "image", file, 50e-6, 1.0, False)
    assert "\n" not in str(caught.value)
    return caught.value.code, str(caught.value)


@pytest.mark.parametrize(
    "file",
    [b"", b"no picture", b"%PDF-1.4", b"\x89PNG\r\n\x1a\n", b"GIF89a", encoded(Image.new("L", (9, 9)), kind="BMP")],
)
@pytest.mark.parametrize("build", [build_image, build_animation])
def test_a_file_that_is_not_an_image_is_refused(file, build):
    code, message = refusal(file, build)
    assert code == "bad_picture"
    assert message.startswith("image: file: got ")


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "GIF"])
def test_a_truncated_image_is_refused(kind):
    noise = grey(np.random.default_rng(3).integers(0, 256, (64, 64)))
    file = encoded(noise, kind=kind)
    assert shown(file).shape == (21, 21)
    for share in (0.2, 0.5, 0.8):
        code, message = refusal(file[: int(len(file) * share)])
        assert code == "bad_picture"
        assert message.startswith("image: file: got ")


def test_large_images_are_refused_before_decoding(monkeypatch):
    code, message = refusal(encoded(Image.new("1", (5000, 4000))))
    assert code == "too_many"
    assert message == "image: file: got '5000 × 4000', expected a picture of at most 16000000 pixels, 20000 a side"
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    for side in (40, 100):  # Pillow only warns up to twice its bound
        assert refusal(encoded(Image.new("1", (side, side))))[0] == "too_many"


@pytest.mark.parametrize("size", [(20_001, 1), (1, 20_001)])
def test_images_with_a_very_long_side_are_refused(size):
    """The weights of the lattice's places took a gigabyte and most of a minute."""
    assert refusal(encoded(Image.new("1", size)))[0] == "too_many"
    assert refusal(encoded(Image.new("1", size)), build_animation)[0] == "too_many"


def join_gif(*sizes):
    """Return a GIF whose images have these sizes, the screen that of the first."""
    images_of = []
    for size in sizes:
        one = encoded(Image.new("P", size, 0), kind="GIF")
        images_of.append(one[one.index(b"\x2c" + struct.pack("<HHHH", 0, 0, *size)) : -1])
    return (
        b"GIF89a"
        + struct.pack("<HHBBB", *sizes[0], 0xF0, 0, 0)
        + b"\xff\xff\xff"
        + bytes(3)
        + b"".join(images_of)
        + b";"
    )


def test_an_animation_that_grows_is_refused_at_the_image_that_is_too_large(monkeypatch):
    """Of 60 kB became two gigabytes, because the size was checked once, at the first image."""
    assert len(build_animation(CONFIG, "t", join_gif((8, 8), (9, 9)), 50e-6, None, False).frames) == 2
    code, message = refusal(join_gif((8, 8), (9, 9), (5000, 4000)), build_animation)
    assert (code, message[:33]) == ("too_many", "image: file: got '5000 × 4000', e")
    monkeypatch.setattr(images, "ANIMATION_PIXELS_MAX", 3 * 64 + 100)
    assert "got '3 pictures of 20264 pixels'" in refusal(join_gif((8, 8), (10, 10), (10, 2010)), build_animation)[1]


def test_long_animations_are_refused(monkeypatch):
    file = encoded(*dots(5), kind="GIF", duration=50)
    monkeypatch.setattr(images, "ANIMATION_FRAMES_MAX", 4)
    assert refusal(file, build_animation) == ("too_many", "image: file: got '5 pictures', expected at most 4")
    monkeypatch.setattr(images, "ANIMATION_FRAMES_MAX", 5)
    assert len(build_animation(CONFIG, "t", file, 50e-6, None, False).frames) == 5
    monkeypatch.setattr(images, "ANIMATION_PIXELS_MAX", 5 * 21 * 21 - 1)
    assert refusal(file, build_animation)[0] == "too_many"


def test_a_drawing_has_the_same_shape_on_every_display():
    picture = Image.new("L", (300, 300), 0)
    ImageDraw.Draw(picture).ellipse((30, 30, 270, 270), fill=255)
    for name in ("display-16", "display-357", "display-1511"):
        lattice = Lattice.from_config(load_config(name))
        bright = compute_lattice_brightness(picture, lattice, False).driven
        radius = np.hypot(lattice.layout.x_m, lattice.layout.y_m) / 4e-3
        half = lattice.index.shape[0] / 2
        assert bright[radius < 0.8 * half - 1].min(initial=1.0) > 1 - 1e-5
        assert bright[radius > 0.8 * half + 1].max(initial=0.0) == 0.0


def test_pillow_is_imported_only_for_images():
    code = (
        "import sys, optodrive.planning.stimuli.pattern_registry as p; p.describe_patterns();"
        " sys.exit('PIL' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
