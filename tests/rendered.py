"""Synthetic pictures of a grid and of the beam's spot, as taken by a camera above the display.

Independent of the camera calibration. The lens distortion of each camera pixel is inverted iteratively and the ray
is intersected with the display's plane.
"""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

SIZE = (1600, 1200)
GRID = {"kind": "chessboard", "rows": 10, "columns": 13, "pitch_m": 7.5e-3}
FIRST_M = (-45.3e-3, 33.9e-3)
TURN_RAD = 0.006


@dataclass(frozen=True)
class Camera:
    """Camera aimed at the display's centre from lateral offset off_m and height away_m.

    k1, k2: lens distortion
    """

    off_m: tuple = (0.06, -0.09)
    away_m: float = 0.42
    roll_rad: float = 0.02
    focal_px: float = 5300.0
    middle_px: tuple = (812.0, 588.0)
    k1: float = -0.6
    k2: float = 0.8

    def pose(self):
        """Return the axes of the camera as rows and its position. The display has x right, y up, z to the front."""
        at = np.array([*self.off_m, self.away_m])
        ahead = -at / np.linalg.norm(at)
        right = np.cross(ahead, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        down = np.cross(ahead, right)
        cos, sin = np.cos(self.roll_rad), np.sin(self.roll_rad)
        return np.array([cos * right + sin * down, cos * down - sin * right, ahead]), at

    def pixel(self, places_m):
        """Project positions [n, 2] to camera pixels [n, 2]."""
        axes, at = self.pose()
        seen = (np.column_stack([places_m, np.zeros(len(places_m))]) - at) @ axes.T
        flat = seen[:, :2] / seen[:, 2:]
        square = (flat**2).sum(axis=1, keepdims=True)
        return self.focal_px * flat * (1 + self.k1 * square + self.k2 * square**2) + self.middle_px

    def places_m(self):
        """Return the positions x and y of every camera pixel, [rows, columns] each."""
        return _places_m(self)


@cache
def _places_m(camera):
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    distorted = (np.stack([x, y]) - np.array(camera.middle_px)[:, None, None]) / camera.focal_px
    flat = distorted.copy()
    for _ in range(12):
        square = (flat**2).sum(axis=0)
        flat = distorted / (1 + camera.k1 * square + camera.k2 * square**2)
    axes, at = camera.pose()
    rays = np.tensordot(axes.T, np.stack([*flat, np.ones_like(flat[0])]), 1)
    return tuple((at[axis] - rays[axis] * at[2] / rays[2]) for axis in (0, 1))


CAMERA = Camera()
TILTED = tuple(
    replace(CAMERA, off_m=off, away_m=away)
    for off, away in (((0.16, 0.02), 0.42), ((-0.15, 0.1), 0.42), ((0.0, 0.18), 0.44), ((-0.1, -0.16), 0.41))
)
PIXEL_M = 0.08e-3


def grid_axes(camera, grid):
    """Return the position of every camera pixel in pitches from the first corner: to the right, down."""
    x, y = camera.places_m()
    x, y = x - FIRST_M[0], y - FIRST_M[1]
    cos, sin = np.cos(TURN_RAD), np.sin(TURN_RAD)
    return (cos * x + sin * y) / grid["pitch_m"], -(cos * y - sin * x) / grid["pitch_m"]


def corners_m(grid=GRID):
    """Return the corners of the grid, [rows, columns, 2]."""
    right, down = np.meshgrid(np.arange(grid["columns"]), np.arange(grid["rows"]))
    x, y = grid["pitch_m"] * right, -grid["pitch_m"] * down
    cos, sin = np.cos(TURN_RAD), np.sin(TURN_RAD)
    return np.stack([cos * x - sin * y + FIRST_M[0], sin * x + cos * y + FIRST_M[1]], axis=-1)


def marks_px(grid=GRID, camera=CAMERA):
    corners = corners_m(grid)
    return camera.pixel(np.array([corners[0, 0], corners[0, -1], corners[-1, 0]]))


def grid_light(camera=CAMERA, grid=GRID):
    """Return the brightness of the grid, 0 black to 1 white, with edges one pixel wide."""
    right, down = grid_axes(camera, grid)
    edge = 0.5 * PIXEL_M / grid["pitch_m"]
    if grid["kind"] == "circles":
        away = np.hypot(right - np.rint(right), down - np.rint(down))
        dots = np.clip((0.25 - away) / (2 * edge) + 0.5, 0, 1)
        inside = (np.rint(right) >= 0) & (np.rint(right) < grid["columns"])
        inside &= (np.rint(down) >= 0) & (np.rint(down) < grid["rows"])
        return 1.0 - dots * inside
    waves = [np.clip(np.arcsin(np.sin(np.pi * at)) / np.pi / edge / 2, -1, 1) for at in (right, down)]
    squares = 0.5 + 0.5 * waves[0] * waves[1]
    inside = [
        np.clip((0.5 * (n + 1) - np.abs(at - 0.5 * (n - 1))) / (2 * edge) + 0.5, 0, 1)
        for at, n in ((right, grid["columns"]), (down, grid["rows"]))
    ]
    return 1.0 - (1.0 - squares) * inside[0] * inside[1]


def spot_light(place_m, camera=CAMERA, width_m=(0.25e-3, 0.15e-3)):
    """Return the brightness of a Gaussian beam spot, 1 at its centre.

    width_m: sigma in x and y
    """
    x, y = camera.places_m()
    return np.exp(-0.5 * (((x - place_m[0]) / width_m[0]) ** 2 + ((y - place_m[1]) / width_m[1]) ** 2))


def taken(light, random, noise=2.0, blur_px=0.8, full=np.uint8):
    """Return the camera picture of brightness in counts: blurred, with vignetting, noise and clipping."""
    x, y = np.meshgrid(np.linspace(-1, 1, SIZE[0]), np.linspace(-1, 1, SIZE[1]))
    shaded = cv2.GaussianBlur(light, (0, 0), blur_px) * (1.0 - 0.2 * (x**2 + y**2))
    noisy = shaded + noise * random.standard_normal(shaded.shape) + 6.0
    return np.clip(np.rint(noisy), 0, np.iinfo(full).max).astype(full)


def describe(folder: Path, grid=GRID, views=("grid.png",), dark="dark.png", spots='table = "pictures.csv"', **other):
    """Write pictures.toml."""
    marks = other.get("marks", marks_px(grid))
    lines = ['format = "optodrive-pictures"', "version = 1"]
    lines += [f'dark = "{dark}"'] if dark else []
    lines += ["[grid]", *(f"{key} = {value!r}" for key, value in grid.items()), f"pictures = {list(views)!r}"]
    lines += ["[origin]", f"marks_px = {np.round(marks).tolist()!r}", f"first_corner_m = {list(FIRST_M)!r}"]
    lines += [f"turn_rad = {TURN_RAD}", "[spots]", spots]
    (folder / "pictures.toml").write_text("\n".join(lines) + "\n")


def save(path: Path, picture):
    assert cv2.imwrite(str(path), picture)
