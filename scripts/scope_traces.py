"""Draw the pins of a Pico as an oscilloscope shows them, from the firmware's image in the emulator of its chip.

python scripts/scope_traces.py [FOLDER]: writes pico-*.svg, by default into docs/pictures.
"""

import sys
import tempfile
from functools import partial
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tests" / name) for name in ("", "conformance", "pico")]

from bench import BRIGHT, Bench, act, here, set_input  # noqa: E402 - of the tests
from emulated_pico import EmulatedPico, PicoImage  # noqa: E402
from emulated_usb_pico import EmulatedUsbPico  # noqa: E402
from virtual_board import PicoBoard, VirtualKind  # noqa: E402

OUT = ROOT / "docs" / "pictures"
LANES = {"indicator": 11, "relay": 12, "gate": 14, "SYNC": 17, "tick": 22}
"""GPIO of what is drawn, from top to bottom, below the inputs."""
PWM_PERIOD_US, PWM_STEPS = 20.0, 2500
SLOW_LANES = {name: LANES[name] for name in ("indicator", "relay", "gate")}
"""Those that are no block of ink over many milliseconds."""
LEFT, WIDTH, LANE, TOP, HIGH = 110, 640, 38, 46, 22
INK, GRID, MARK = "#1c3d5a", "#c9d2da", "#b03a2e"


class Traced(EmulatedPico):
    """A Pico whose pins are recorded as (time, level) while it is traced."""

    def __init__(self, image, settings, sink, seed=None):
        self.levels = {pin: [(0.0, False)] for pin in LANES.values()}
        self.shown = {}
        super().__init__(image, settings, sink, seed)

    def trace(self, on=True):
        """Record from now on, or no longer."""
        self._command("trace", on)

    def set_input(self, name, value, now_us):
        """Change an input, and record it as a lane of its own."""
        self.advance(now_us)
        self.shown.setdefault(name, [(0.0, self.inputs[name])]).append((self.chip_us, value))
        super().set_input(name, value, now_us)

    def _on_level(self, at_us, pin, high):
        self.levels[pin].append((at_us, high))

    def _on_pin(self, at_us, on, compare):
        super()._on_pin(at_us, on, compare)
        self.levels[LANES["gate"]].append((at_us, compare if on else False))

    def _on_reset(self, at_us, cause):
        super()._on_reset(at_us, cause)
        for edges in self.levels.values():
            edges.append((at_us, False))


class TracedUsbPico(Traced, EmulatedUsbPico):
    """The same with its host on its own USB port."""


def expand_pwm(edges, until_us):
    """Replace each time of the gate at less than full duty by the periods of its PWM."""
    out = []
    for (at_us, compare), (end_us, _) in zip(edges, [*edges[1:], (until_us, None)], strict=True):
        if not compare or compare >= PWM_STEPS:
            out.append((at_us, bool(compare)))
            continue
        period_us = at_us
        while period_us < min(end_us, until_us):
            out += [(period_us, True), (period_us + PWM_PERIOD_US * compare / PWM_STEPS, False)]
            period_us += PWM_PERIOD_US
    return out


def draw_lane(edges, since_us, until_us, y, scale):
    """Return the path of one lane."""
    level = next((level for at_us, level in reversed(edges) if at_us <= since_us), False)
    path = f"M{LEFT} {y - HIGH * level:g}"
    for at_us, now in edges:
        if since_us < at_us <= until_us and now != level:
            path += f"H{LEFT + (at_us - since_us) * scale:.1f}V{y - HIGH * now:g}"
            level = now
    return f'<path d="{path}H{LEFT + WIDTH}" fill="none" stroke="{INK}" stroke-width="1.4"/>'


def format_time(us):
    """Return a time with the unit that suits it."""
    return f"{us * 1e-3:.4g} ms" if abs(us) >= 1000 else f"{us:.3g} µs"


def draw(pico, title, since_us, until_us, marks=(), lanes=LANES):
    """Return the SVG picture of a time span. marks: (time, text), counted from the first one."""
    scale = WIDTH / (until_us - since_us)
    rows = {name: pico.shown[name] for name in pico.shown} | {
        f"{name}, GP{pin}": pico.levels[pin] for name, pin in lanes.items()
    }
    height = TOP + LANE * len(rows) + 26
    box, font = f"0 0 {LEFT + WIDTH + 20} {height}", 'font-family="sans-serif" font-size="12"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}" {font}>',
        f'<rect width="100%" height="100%" fill="#fff"/><text x="8" y="16" font-weight="bold">{title}</text>',
    ]
    for k in range(11):
        x = LEFT + WIDTH * k / 10
        parts.append(f'<path d="M{x:g} {TOP}V{height - 24}" stroke="{GRID}"/>')
    division = f"{format_time((until_us - since_us) / 10)} per division"
    parts.append(f'<text x="{LEFT + WIDTH}" y="{height - 8}" text-anchor="end">{division}</text>')
    for row, (name, edges) in enumerate(rows.items()):
        y = TOP + LANE * (row + 1) - 8
        edges = expand_pwm(edges, until_us) if name.startswith("gate") else edges
        parts += [f'<text x="8" y="{y}">{name}</text>', draw_lane(edges, since_us, until_us, y, scale)]
    zero_us = marks[0][0] if marks else 0.0
    for number, (at_us, text) in enumerate(marks):
        x = LEFT + (at_us - since_us) * scale
        side, dx = ("end", -4) if x > LEFT + WIDTH * 0.6 else ("start", 4)
        label = f"{text}, {format_time(at_us - zero_us)}" if number else text
        parts.append(f'<path d="M{x:.1f} {TOP - 6}V{height - 24}" stroke="{MARK}" stroke-dasharray="4 3"/>')
        place = f'x="{x + dx:.1f}" y="{TOP - 18 + 12 * (number % 2)}" text-anchor="{side}"'
        parts.append(f'<text {place} fill="{MARK}">{label}</text>')
    return "\n".join([*parts, "</svg>\n"])


def first_change(edges, after_us, level):
    """Return when a lane first took a level after a time."""
    return next(at_us for at_us, now in edges if at_us > after_us and bool(now) == level)


def last_off(edges):
    """Return when the gate went off and did not come on any more."""
    last_on_us = max(at_us for at_us, now in edges if now)
    return first_change(edges, last_on_us, False)


def draw_power_up(image):
    """The relay closes once the DAC is set up and all is checked; the gate stays low."""
    pico = Traced(image, None, lambda event: None, seed=1)
    pico.trace()
    pico.advance(10_000)
    relay_us = first_change(pico.levels[LANES["relay"]], 0, True)
    tick_us = first_change(pico.levels[LANES["tick"]], 0, True)
    marks = [(0.0, "power"), (relay_us, "relay closes"), (tick_us, "first tick")]
    picture = draw(pico, "Power-up", 0.0, 10_000.0, marks)
    pico.close()
    return picture


def next_step(host):
    """Carry out the next step of a board's script."""
    host.board.next_step()


def draw_ends(image, folder):
    """Return the pictures of a pulse, and of each way in which light ends, by name."""
    pictures = {}

    def play(name, title, span_us, cause, step=None, lanes=LANES, core=Traced, **limits):
        """Light the gate, let something end it, and draw the time from before to after."""
        bench = Bench(VirtualKind("pico", partial(core, image), make_board=PicoBoard), folder / name)
        (folder / name).mkdir()
        host = bench.ready(*([step] if step else []), **(BRIGHT | limits))
        host.shine(duty=65535, seconds=1)
        host.pause(0.02)
        pico = host.board.core
        pico.trace()
        pico.advance(host.clock.now_us() + round(span_us * 0.25))
        since_us = pico.chip_us
        cause(host)
        pico.advance(round(since_us + span_us))
        off_us = last_off(pico.levels[LANES["gate"]])
        marks = [(since_us, title.partition(":")[2].strip()), (off_us, "gate off")]
        pictures[name] = draw(pico, title, since_us - 0.2 * span_us, since_us + 0.8 * span_us, marks, lanes)
        bench.finish(lambda board: None)

    play("interlock", "Interlock: opened", 1000, next_step, set_input("interlock", False))
    play("closed", "Adapter: port closed", 1000, lambda host: host.close())
    unplug = {"core": TracedUsbPico, "lanes": SLOW_LANES}
    play("unplugged", "USB: unplugged", 10_000, lambda host: host.board.core.usb("unplug"), **unplug)
    silent = {"lanes": SLOW_LANES, "lease_ms": 100}
    play("lease", "Lease: last LEASE", 160_000, lambda host: host.send("LEASE", ms=60_000), **silent)
    play("watchdog", "Watchdog: main loop stopped", 60_000, next_step, act("stop_loop"), SLOW_LANES)
    return pictures


def draw_pulse(image, folder):
    """A move of 8,000 codes, its settling, and a pulse of 300 µs at a quarter of full power."""
    folder.mkdir()
    bench = Bench(VirtualKind("pico", partial(Traced, image), make_board=PicoBoard), folder)
    host = bench.ready(settle_us=190, settle_ns_per_code=50, **BRIGHT)
    pico = host.board.core
    pico.trace()
    since_us = pico.chip_us
    assert host.play(here(300, x=40_768, duty=16_384)) == []
    host.wait_for_change("job done")
    (move_us,) = (at_us for at_us, x, _ in pico.mirrors if x == 40_768)
    gate = pico.levels[LANES["gate"]]
    on_us, off_us = first_change(gate, since_us, True), first_change(gate, since_us, False)
    marks = [(move_us, "mirrors move"), (on_us, "gate on"), (off_us, "gate off")]
    picture = draw(pico, "One point", move_us - 100, move_us + 1100, marks)
    bench.finish(lambda board: None)
    return picture


def main(folder):
    """Draw all pictures into a folder."""
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        image = PicoImage(work)
        pictures = {"power-up": draw_power_up(image), "point": draw_pulse(image, work / "point")}
        pictures |= draw_ends(image, work)
    for name, picture in pictures.items():
        path = folder / f"pico-{name}.svg"
        path.write_text(picture)
        print(f"{path.name}: {len(picture)} bytes")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else OUT)
