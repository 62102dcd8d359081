"""Recording of `optodrive simulate`: simulated instruments measure the traces, once or repeatedly."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from optodrive.core.errors import InputError
from optodrive.core.quantity import format_quantity

if TYPE_CHECKING:
    from collections.abc import Sequence

    from optodrive.core.types.measurements import PixelTrace, Run
    from optodrive.core.types.plans import ExecutedPulses
    from optodrive.planning.display_model import DisplayModel

REPEATS_MAX = 100
GROUP_MAX = 200
"""Maximum number of characters of a group's name."""
DEFAULT_GROUP = "simulated"


class InstrumentSettings(NamedTuple):
    """Noise of the instruments as a factor of theirs, its seed, the number of repeats, and their group if stated."""

    noise: float
    seed: int
    repeats: int
    group: str | None

    def check(self, out: Path | None) -> None:
        """Raise InputError for a setting out of range, or that needs a recording.

        out: the recording
        """
        if not 0.0 <= self.noise <= 1000.0:
            raise InputError("--noise", self.noise, "a factor between 0 and 1000")
        if not 1 <= self.repeats <= REPEATS_MAX:
            raise InputError("--repeats", self.repeats, f"a number from 1 to {REPEATS_MAX}")
        if self.group is not None and not (0 < len(self.group) <= GROUP_MAX and self.group.isprintable()):
            raise InputError("--group", self.group, f"1 to {GROUP_MAX} printable characters")
        if out is None and self.repeats > 1:
            raise InputError("--repeats", self.repeats, "--out, the recording of the repeats")
        if out is None and self.group is not None:
            raise InputError("--group", self.group, "--out, the recording of the group")

    def name_group(self, pixel: int, pixel_count: int) -> str | None:
        """Return the group of a pixel's runs, None without repeats and name. Different pixels never share a group."""
        if self.group is None and self.repeats == 1:
            return None
        name = self.group or DEFAULT_GROUP
        return name if pixel_count == 1 else f"{name}, pixel {pixel}"

    def describe(self) -> list[str]:
        """Return the lines that state noise and repeats."""
        return [f"noise            {_describe_noise(self.noise)}"] + (
            [f"repeats          {self.repeats} of every run, each with its own noise"] if self.repeats > 1 else []
        )


def record_traces(
    out: Path,
    display: "DisplayModel",
    executed: "ExecutedPulses",
    traces: "list[PixelTrace]",
    instruments: InstrumentSettings,
    true_terms: "Sequence[str]",
) -> None:
    """Write one recording with a run per pixel and repeat, each with the pulses during the pixel's trace.

    true_terms: of the simulated display and its instruments
    """
    import numpy as np

    from optodrive.core.types.measurements import Measurement
    from optodrive.device.pixel_map import load_pixel_map
    from optodrive.lab.recording import write_recording
    from optodrive.link.simulator.pixel_recorder import measure
    from optodrive.physics.terms import all_terms

    coupling = "AC" if any(all_terms()[key].removes_zero for key in true_terms) else "DC"
    pulses = np.column_stack([executed.start_s, executed.width_s, executed.power_w, executed.pixel])
    pixel_map, rng = load_pixel_map(display.config), np.random.default_rng(instruments.seed)
    aim_m = None if pixel_map is None else np.array([pixel_map.offset_x_m, pixel_map.offset_y_m])
    width_m, pixel_count = display.config.display.bridge_width_m, sum(len(item.pixel) for item in traces)
    runs: list[Run] = []
    for repeat in range(instruments.repeats):
        for item in traces:
            within = (pulses[:, 0] + pulses[:, 1] >= item.t_s[0]) & (pulses[:, 0] <= item.t_s[-1])
            measured = measure(item, pulses[within], display.ambient_k, width_m, instruments.noise, rng, aim_m).runs
            pixels = item.pixel.tolist()
            runs += [
                _label_run(run, repeat, instruments, instruments.name_group(pixel, pixel_count), coupling)
                for run, pixel in zip(measured, pixels, strict=True)
            ]
    write_recording(out, Measurement(tuple(runs)))


def _label_run(run: "Run", repeat: int, instruments: InstrumentSettings, group: str | None, coupling: str) -> "Run":
    """Return the run with the name of its repeat, with its group and with the coupling of its instruments."""
    name = run.name if instruments.repeats == 1 else f"{run.name}-repeat-{repeat + 1}"
    attributes = run.attributes | {"coupling": coupling} | ({} if group is None else {"group": group})
    return replace(run, name=name, attributes=attributes)


def _describe_noise(noise: float) -> str:
    from optodrive.link.simulator.pixel_recorder import INSTRUMENT_SIGMA

    if noise == 0.0:
        return "none: the recording is exact, as no instrument's is"
    sigmas = (format_quantity(noise * sigma, name.rsplit("_", 1)[1]) for name, sigma in INSTRUMENT_SIGMA.items())
    return f"{', '.join(sigmas)} rms added to the recording; --noise 0: none"
