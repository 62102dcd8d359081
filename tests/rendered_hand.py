"""Synthetic pictures of hands over a display, by casting rays onto spheres and a plane.

Independent of the detector. A finger is a row of spheres from its tip, which the plane flattens, up to the knuckle; the
centre of its pad lies below the centre of the tip's sphere. From above the display reflects, with its dark absorbers
and soft shadows of the hand; from below the hand is dark before a bright ceiling, seen between the absorbers.
"""

from dataclasses import dataclass

import cv2
import numpy as np

SIZE = (800, 600)
PITCH_M, ROWS = 4e-3, 39
MARKS = {7: (-0.094, -0.094), 3: (0.094, -0.094), 11: (0.094, 0.094), 0: (-0.094, 0.094)}
SIDE_M = 0.016
LIGHT = np.array([0.45, 0.25, 0.86])


@dataclass(frozen=True)
class Camera:
    """A pinhole camera aimed at the display's centre. at_m: its place, above the display or, with z < 0, below."""

    at_m: tuple = (0.05, -0.06, 0.50)
    focal_px: float = 1150.0
    roll_rad: float = 0.1

    def axes(self):
        at = np.array(self.at_m)
        ahead = -at / np.linalg.norm(at)
        right = np.cross(ahead, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        down = np.cross(ahead, right)
        cos, sin = np.cos(self.roll_rad), np.sin(self.roll_rad)
        return np.array([cos * right + sin * down, cos * down - sin * right, ahead])

    def project(self, places_m):
        seen = (np.asarray(places_m) - self.at_m) @ self.axes().T
        return self.focal_px * seen[:, :2] / seen[:, 2:] + 0.5 * np.array(SIZE)

    def rays(self):
        """Return the direction of the ray of every camera pixel, [rows, columns, 3]."""
        x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
        flat = np.stack([x - 0.5 * SIZE[0], y - 0.5 * SIZE[1], np.full(x.shape, self.focal_px)], axis=-1)
        rays = flat @ self.axes()
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


ABOVE = Camera()
BELOW = Camera(at_m=(-0.04, 0.05, -0.52), roll_rad=-0.2)


@dataclass(frozen=True)
class Finger:
    """A finger that touches the display. heading_rad: direction in which it points; rise_rad: its slope."""

    pad_m: tuple
    heading_rad: float = np.pi / 2
    rise_rad: float = 0.5
    radius_m: float = 7e-3
    length_m: float = 0.07
    flattened_m: float = 1e-3

    def spheres(self):
        back = -np.array([np.cos(self.heading_rad), np.sin(self.heading_rad)])
        along = np.arange(0.0, self.length_m, 1e-3)[:, None]
        radius = self.radius_m + 0.025 * along
        height = self.radius_m - self.flattened_m + np.sin(self.rise_rad) * along
        return np.hstack([self.pad_m + np.cos(self.rise_rad) * along * back, height, radius])

    def knuckle(self):
        return self.spheres()[-1, :3]


def hand(fingers):
    """Return spheres [n, 4] of fingers, of the fist of those that do not touch, and of the arm."""
    knuckles = np.array([finger.knuckle() for finger in fingers])
    back = -np.mean([[np.cos(f.heading_rad), np.sin(f.heading_rad)] for f in fingers], axis=0)
    back = np.append(back / np.linalg.norm(back), 0.0)
    middle = knuckles.mean(axis=0) + 0.02 * back + [0.0, 0.0, 0.005]
    fist = [[*(middle + side * np.array([-back[1], back[0], 0.0]) * 0.02), 0.022] for side in (-1, 0, 1)]
    arm = [[*(middle + along * back), 0.026] for along in np.arange(0.01, 0.3, 0.004)]
    return np.vstack([*(finger.spheres() for finger in fingers), fist, arm])


def marker_light(x, y, is_below):
    """Return reflectances of the marks at places of the plane, NaN beside them."""
    light = np.full(x.shape, np.nan)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for number, (mark_x, mark_y) in MARKS.items():
        u, v = (x - mark_x) / SIDE_M, -(y - mark_y) / SIDE_M
        u = -u if is_below else u
        paper = (np.abs(u) < 0.65) & (np.abs(v) < 0.65)
        light[paper] = 0.85
        bits = cv2.aruco.generateImageMarker(dictionary, number, 6) / 255.0
        black = (np.abs(u) < 0.5) & (np.abs(v) < 0.5)
        light[black] = 0.06 + 0.79 * bits[((v[black] + 0.5) * 6).astype(int), ((u[black] + 0.5) * 6).astype(int)]
    return light


def is_absorber(x, y):
    column, row = x / PITCH_M + 0.5 * (ROWS - 1), y / PITCH_M + 0.5 * (ROWS - 1)
    inside = (np.abs(x) < 0.5 * ROWS * PITCH_M) & (np.abs(y) < 0.5 * ROWS * PITCH_M)
    near = (np.abs(column - np.rint(column)) * PITCH_M < 1e-3) & (np.abs(row - np.rint(row)) * PITCH_M < 0.75e-3)
    return inside & near


def hit_spheres(camera, rays, spheres):
    """Return the distance to the first sphere along each ray, infinite without, and the cosine of its light."""
    distance, cosine = np.full(rays.shape[:2], np.inf), np.zeros(rays.shape[:2])
    at = np.array(camera.at_m)
    light = LIGHT * [1.0, 1.0, np.sign(at[2])]
    for *centre, radius in spheres:
        middle = camera.project([centre])[0]
        reach = int(1.3 * camera.focal_px * radius / np.linalg.norm(centre - at)) + 2
        left, right = np.clip([middle[0] - reach, middle[0] + reach + 1], 0, SIZE[0]).astype(int)
        top, bottom = np.clip([middle[1] - reach, middle[1] + reach + 1], 0, SIZE[1]).astype(int)
        ray = rays[top:bottom, left:right]
        along = ray @ (centre - at)
        square = along**2 - np.sum((centre - at) ** 2) + radius**2
        near = along - np.sqrt(np.maximum(square, 0.0))
        point = at + near[..., None] * ray
        hit = (square > 0.0) & (point[..., 2] > -1e-9) & (near < distance[top:bottom, left:right])
        if at[2] < 0.0:  # the plane cuts the sphere: its flat is seen where the ray enters it
            flat = -at[2] / ray[..., 2]
            on_plane = (
                np.hypot(*np.moveaxis(at + flat[..., None] * ray - centre, -1, 0)[:2]) ** 2 + centre[2] ** 2 < radius**2
            )
            hit |= (square > 0.0) & on_plane & (flat < distance[top:bottom, left:right])
            near = np.where(on_plane, flat, near)
        distance[top:bottom, left:right][hit] = near[hit]
        cosine[top:bottom, left:right][hit] = ((point - centre) @ light / radius)[hit]
    return distance, cosine


def shade_plane(x, y, spheres):
    """Return the share of the light that a hand leaves at places of the plane, in soft shadows."""
    grid_m = 2e-3
    grid_x, grid_y = np.meshgrid(np.arange(-0.2, 0.2, grid_m), np.arange(-0.2, 0.2, grid_m))
    shadow = np.zeros(grid_x.shape)
    light = LIGHT / np.linalg.norm(LIGHT)
    for *centre, radius in spheres[::3]:
        to_x, to_y, to_z = centre[0] - grid_x, centre[1] - grid_y, centre[2]
        along = light[0] * to_x + light[1] * to_y + light[2] * to_z
        shadow[to_x**2 + to_y**2 + to_z**2 - along**2 < radius**2] = 1.0
    shadow = cv2.GaussianBlur(shadow, (0, 0), 1.5)
    return 1.0 - 0.22 * cv2.remap(
        shadow.astype(np.float32),
        ((x + 0.2) / grid_m).astype(np.float32),
        ((y + 0.2) / grid_m).astype(np.float32),
        cv2.INTER_LINEAR,
    )


def render(camera, fingers, random, skin=0.8, exposure=1.0, noise=3.0, blur_px=1.0):
    """Return the camera's grey picture of fingers on the display, or of the display alone."""
    rays, at = camera.rays(), np.array(camera.at_m)
    plane = -at[2] / rays[..., 2]
    x, y = (at[axis] + plane * rays[..., axis] for axis in (0, 1))
    spheres = hand(fingers) if fingers else np.zeros((0, 4))
    distance, cosine = hit_spheres(camera, rays, spheres)
    lamp = 0.75 + 1.2 * x - 0.9 * y - 6.0 * (x**2 + y**2)
    is_below = at[2] < 0.0
    marks = marker_light(x, y, is_below)
    if is_below:
        light = np.where(np.isfinite(distance), skin * (0.18 + 0.1 * np.maximum(0.0, cosine)), 0.75 * lamp)
        light = 0.9 * light + 0.05  # haze of the panel
        light = np.where(is_absorber(x, y), 0.12 * lamp, light)
        light = np.where(np.isfinite(marks), np.nan_to_num(marks) * lamp, light)
    else:
        board = np.where(np.isfinite(marks), np.nan_to_num(marks), np.where(is_absorber(x, y), 0.08, 0.3))
        board = board * shade_plane(x, y, spheres)
        board = board * lamp
        light = np.where(distance < plane, skin * lamp * (0.55 + 0.45 * np.maximum(0.0, cosine)), board)
    counts = 255.0 * exposure * cv2.GaussianBlur(light, (0, 0), blur_px)
    counts = counts + noise * random.standard_normal(counts.shape)
    return np.clip(np.rint(counts), 0, 255).astype(np.uint8)


def random_hand(random, count=2, apart_m=0.018, turned=0.6):
    """Return the fingers of a hand at a random place, side by side. turned: largest angle from straight ahead."""
    heading = np.pi / 2 + random.uniform(-turned, turned)
    side = np.array([np.sin(heading), -np.cos(heading)])
    ahead = np.array([np.cos(heading), np.sin(heading)])
    first, spread = random.uniform(-0.06, 0.06, 2), random.uniform(0.0, 0.15)
    return [
        Finger(
            tuple(first + number * apart_m * side + random.uniform(-3e-3, 3e-3) * ahead),
            heading_rad=heading - number * spread,
            rise_rad=random.uniform(0.25, 0.7),
            radius_m=random.uniform(6e-3, 8e-3),
        )
        for number in range(count)
    ]


def take_picture(camera, fingers, random):
    """Render with skin, exposure, noise and blur at random."""
    return render(
        camera,
        fingers,
        random,
        skin=random.uniform(0.65, 0.95),
        exposure=random.uniform(0.93, 1.07),
        noise=random.uniform(2.0, 4.0),
        blur_px=random.uniform(0.7, 1.6),
    )


def write_marks(path, marks=MARKS, side_m=SIDE_M):
    """Write marks.toml."""
    lines = ['format = "optodrive-marks"', "version = 1", f"side_m = {side_m}"]
    for number, (x_m, y_m) in marks.items():
        lines += ["[[marks]]", f"id = {number}", f"x_m = {x_m}", f"y_m = {y_m}"]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_video(path, pictures, rate_hz=30.0):
    """Write grey pictures as a video."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), rate_hz, SIZE, False)
    assert writer.isOpened()
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return path
