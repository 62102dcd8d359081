"""A simulated multitouch film: what the kernel's input layer passes on of fingers that a script moves.

Independent of the decoder. Like the kernel it sends a value only when it changes, keeps the values of a slot when its
finger is lifted, and gives a new finger the lowest free slot.
"""

from dataclasses import dataclass, field

import numpy as np

SLOT, X, Y, TRACKING = 0x2F, 0x35, 0x36, 0x39
REPORT, DROPPED = (0, 0, 0), (0, 3, 0)


@dataclass
class SimulatedFilm:
    """A film beside or below the display.

    size: values of its axes; per_mm: values per millimetre; origin_m: place of its value 0, 0 on the display; turn_rad;
    mirrored: as seen from behind; noise_m: of a measured place, per axis; slots: most fingers at a time
    """

    size: tuple = (4096, 4096)
    per_mm: int = 20
    origin_m: tuple = (0.102, -0.101)
    turn_rad: float = 0.02
    mirrored: bool = True
    noise_m: float = 3e-4
    slots: int = 10
    seed: int = 7
    events: list = field(default_factory=list)

    def __post_init__(self):
        self.random = np.random.default_rng(self.seed)
        self.current, self.next_id = 0, 65530
        self.states = [{TRACKING: -1, X: 0, Y: 0} for _ in range(self.slots)]
        self.slot_of = {}

    def axes_m(self):
        """Return the directions of the film's axes on the display as columns."""
        cos, sin = np.cos(self.turn_rad), np.sin(self.turn_rad)
        return np.array([[cos, -sin], [sin, cos]]) @ np.diag([-1.0 if self.mirrored else 1.0, 1.0])

    def measure(self, place_m):
        """Return the values x and y of a finger on the display, quantised, with noise."""
        noisy_m = np.array(place_m) + self.noise_m * self.random.standard_normal(2) - self.origin_m
        return np.clip(np.rint(1e3 * self.per_mm * (self.axes_m().T @ noisy_m)), 0, np.array(self.size) - 1).astype(int)

    def send(self, at_s, kind, code, value):
        self.events.append((at_s, kind, code, int(value)))

    def _set(self, at_s, slot, code, value):
        if self.states[slot][code] == value:
            return
        if self.current != slot:
            self.send(at_s, 3, SLOT, slot)
            self.current = slot
        self.states[slot][code] = int(value)
        self.send(at_s, 3, code, value)

    def report(self, at_s, fingers):
        """Pass on fingers at a time, {key: (x_m, y_m)}. One that is missing is lifted."""
        sent = len(self.events)
        for key in [key for key in self.slot_of if key not in fingers]:
            self._set(at_s, self.slot_of.pop(key), TRACKING, -1)
        for key, place_m in fingers.items():
            if key not in self.slot_of:
                self.slot_of[key] = min(set(range(self.slots)) - set(self.slot_of.values()))
                self._set(at_s, self.slot_of[key], TRACKING, self.next_id)
                self.next_id = (self.next_id + 1) % 65536
            x, y = self.measure(place_m)
            self._set(at_s, self.slot_of[key], X, x)
            self._set(at_s, self.slot_of[key], Y, y)
        if len(self.events) > sent:
            self.send(at_s, *REPORT)

    def restate(self, at_s):
        """State all slots, as a reader does that asks the kernel for them."""
        for slot, state in enumerate(self.states):
            self.send(at_s, 3, SLOT, slot)
            for code, value in state.items():
                self.send(at_s, 3, code, value)
        self.send(at_s, 3, SLOT, self.current)
        self.send(at_s, *REPORT)

    def move(self, begin_s, seconds, fingers, rate_hz=100.0):
        """Report fingers that move, {key: function of the time}, and that are None where they do not touch."""
        for step in range(round(seconds * rate_hz)):
            at_s = begin_s + step / rate_hz
            places = {key: find(at_s) for key, find in fingers.items()}
            self.report(at_s, {key: place_m for key, place_m in places.items() if place_m is not None})
        return begin_s + seconds

    def touch(self, begin_s, place_m, seconds=0.5, rate_hz=100.0):
        """Touch a place with one finger and lift it. Return the end."""
        end_s = self.move(begin_s, seconds, {("touch", begin_s): lambda _: place_m}, rate_hz)
        self.report(end_s, {})
        return end_s + 0.3

    def write(self, path, begin_s=12.5):
        """Write a recording as evemu-record does, with lines and comments that concern nobody else."""
        lines = ["# EVEMU 1.3", "# Input device name: film", "N: Film, 10 fingers", "I: 0003 1234 5678 0110"]
        lines += ["P: 02 00 00 00 00 00 00 00", "B: 00 0b 00 00 00 00 00 00 00"]
        lines += [
            f"A: {X:02x} 0 {self.size[0] - 1} 0 0 {self.per_mm}",
            f"A: {Y:02x} 0 {self.size[1] - 1} 0 0 {self.per_mm}",
        ]
        lines += [f"A: {SLOT:02x} 0 {self.slots - 1} 0 0 0", f"A: {TRACKING:02x} 0 65535 0 0 0", "A: 3a 0 255 0 0"]
        for at_s, kind, code, value in self.events:
            note = "# ------------ SYN_REPORT (0) ----------" if (kind, code) == (0, 0) else "# EV_ABS"
            lines.append(f"E: {begin_s + at_s:.6f} {kind:04x} {code:04x} {value:04d}\t{note}")
        path.write_text("\n".join(lines) + "\n")
        return path
