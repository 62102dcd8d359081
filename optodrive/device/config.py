"""The configuration of one display as a model that is checked as a whole."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from os.path import realpath
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from optodrive.core.errors import MISSING, InputError, Unquoted
from optodrive.core.laser_power import find_min_power_w
from optodrive.core.plausibility import PlausibleRange
from optodrive.core.toml_model import ConflictError, Name, Section
from optodrive.core.types.arrays import BoolArray, FloatArray, IntArray, ReadOnlyArrays
from optodrive.device.config_sections import (
    CLOCKED_DACS,
    DAC_HALF_RANGE_CODES,
    DAC_POWER_STEPS,
    HALF_RANGE_CODES,
    POWER_STEPS,
    BoardSection,
    DaemonSection,
    DisplaySection,
    LaserSection,
    LimitsSection,
    PanelSection,
    PixelModelSection,
    ScannerSection,
    SensorSection,
    StageSection,
)

FORMAT = "optodrive-config"
VERSION = 1
DAMPING_MAX = 0.995
"""Largest damping ratio of a servo with two poles that ring."""

XY2_100_DELAY_S = 2e-5
"""Longest time from a move to the end of the frame that carries it."""


class Config(Section):
    """The configuration of one display."""

    format: Literal["optodrive-config"]
    """Name of the format."""
    version: Literal[1]
    """Version of the format."""
    name: Name
    """Name of the display."""
    ambient_c: Annotated[float, Field(ge=-20, le=60), PlausibleRange(0.0, 60.0, "°C")]
    """Ambient temperature, °C."""
    display: DisplaySection
    """The pixel lattice."""
    pixel_model: PixelModelSection = PixelModelSection()
    """The pixel model."""
    panel: PanelSection = PanelSection()
    """The panel."""
    laser: LaserSection
    """The laser."""
    scanner: ScannerSection
    """Mirrors and lens."""
    limits: LimitsSection
    """Caps."""
    board: BoardSection
    """The board."""
    sensor: SensorSection | None = None
    """The spot sensor."""
    stages: Annotated[tuple[StageSection, ...], Field(max_length=8)] = ()
    """Optical stages, if there are several."""
    daemon: DaemonSection = DaemonSection()
    """The daemon."""
    _file: str = PrivateAttr("")

    @model_validator(mode="before")
    @classmethod
    def _complete_stages(cls, table: Any) -> Any:
        """Fill in the keys that a stage does not state."""
        stages = table.get("stages") if isinstance(table, dict) else None
        if not isinstance(stages, list) or not all(isinstance(stage, dict) for stage in stages):
            return table
        completed = []
        for stage in stages:
            sections = {
                # Before the sections are validated: a key of the file may be right only together with that of the
                # stage.
                key: table[key] | stage.get(key, {})
                for key in ("laser", "scanner", "board")
                if isinstance(table.get(key), dict) and isinstance(stage.get(key, {}), dict)
            }
            completed.append(stage | sections)
        return table | {"stages": completed}

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
        limits = self.limits
        # A cap at ambient temperature leaves no light, and the limiter's chords no span.
        for key in ("absorber_max_c", "wall_max_c", "touch_max_c"):
            if getattr(limits, key) <= self.ambient_c:
                raise ConflictError(f"limits.{key}", getattr(limits, key), f"more than ambient_c {self.ambient_c}")
        for key, larger in (
            ("wall_max_c", "absorber_max_c"),
            ("pixel_mean_power_max_w", "display_mean_power_max_w"),
            ("pulse_width_max_s", "pixel_mean_window_s"),
            ("pulse_width_max_s", "display_mean_window_s"),
        ):
            if getattr(limits, key) > getattr(limits, larger):
                expected = f"at most limits.{larger} {getattr(limits, larger)}"
                raise ConflictError(f"limits.{key}", getattr(limits, key), expected)
        return self

    @model_validator(mode="after")
    def _check_stages(self) -> Self:
        for number, config in enumerate(self.list_stage_configs()):
            try:
                config.check_optics()
            except ConflictError as error:
                place = f"stages[{number}].{error.place}" if self.stages else error.place
                raise ConflictError(place, error.value, error.expected) from None
        for number, stage in enumerate(self.stages):
            if len(self.stages) > 1 and stage.board.is_dac:
                place, expected = f"stages[{number}].board.transport", "a board's: laser DACs have no common clock"
                raise ConflictError(place, stage.board.transport, expected)
            for key, ours in (("name", stage.name), ("board", stage.board.address)):
                for other, earlier in enumerate(self.stages[:number]):
                    # Two stages on one port: the second would open it while the first has the lease.
                    if ours and ours == (earlier.name if key == "name" else earlier.board.address):
                        value = stage.name if key == "name" else Unquoted(" ".join(map(str, ours)))
                        expected = f"another {key} than that of stages[{other}]"
                        raise ConflictError(f"stages[{number}].{key}", value, expected)
        if self.sensor is not None:
            boards = [config.board.address for config in self.list_stage_configs()]
            if ("serial", realpath(self.sensor.port)) in boards:
                raise ConflictError("sensor.port", self.sensor.port, "another port than that of a board")
        reach = np.stack([stage.reach for stage in self.list_stage_configs()])
        unreached = np.flatnonzero(~reach.any(axis=0))
        if len(unreached):
            raise ConflictError("stages", Unquoted(f"none that reaches pixel {unreached[0]}"), "one")
        if self.daemon.on_stage_loss == "that_stage":
            self._check_spare_reach(reach)
        return self

    def _check_spare_reach(self, reach: BoolArray) -> None:
        """Check that each pixel is reached by another stage when one is lost. reach: [k, p]. Raise ConflictError."""
        alone = np.flatnonzero(np.count_nonzero(reach, axis=0) < 2)
        if len(alone):
            expected = "all_dark with one stage"
            if len(self.stages) > 1:
                name = self.stages[int(np.argmax(reach[:, alone[0]]))].name
                expected = f"all_dark while stage {name!r} is the only one that reaches pixel {alone[0]}"
            raise ConflictError("daemon.on_stage_loss", self.daemon.on_stage_loss, expected)

    def check_optics(self) -> None:
        """Check laser, scanner and board of the only stage, and that its beam has pixels. Raise ConflictError."""
        self._check_reach()
        if self.limits.pulse_width_max_s < 1.0 / self.laser.pwm_hz:
            expected = f"at least one period of laser.pwm_hz, {1 / self.laser.pwm_hz}"
            raise ConflictError("limits.pulse_width_max_s", self.limits.pulse_width_max_s, expected)
        self._check_scan_range()
        self._check_focus()
        self._check_damping()
        self._check_trajectories()
        self._check_modulation()
        self._check_converter_codes()
        self._check_interface()

    def _check_reach(self) -> None:
        for stage in self.stages[:1]:
            for key in ("rows", "columns"):
                span, count = getattr(stage, key), getattr(self.display, key)
                if span is not None and not 0 <= span[0] <= span[1] < count:
                    raise ConflictError(key, list(span), f"the first and the last of 0 to {count - 1}")
        if not self.reach.any():
            raise ConflictError("rows", Unquoted("no pixel within rows and columns"), "at least one")

    def _check_scan_range(self) -> None:
        layout, reach = build_pixel_layout(self.display), self.reach
        half_field_m = 2.0 * self.scanner.range_rad * self.scanner.focal_length_m
        farthest_m = float(max(np.abs(layout.x_m[reach]).max(), np.abs(layout.y_m[reach]).max()))
        if farthest_m > half_field_m:
            value, expected = f"±{half_field_m:.4f} m by focal_length_m", f"±{farthest_m:.4f} m, where a pixel lies"
            raise ConflictError("scanner.range_rad", Unquoted(f"a reach of {value}"), f"at least {expected}")

    def _check_focus(self) -> None:
        display, laser = self.display, self.laser
        # Rounding takes half a step of the aim and one of the move, and something must be left.
        min_rad = 2.0 * self.scanner.rad_per_code
        for side, tolerance_rad in zip(("width", "height"), self.tolerance_rad, strict=True):
            if tolerance_rad <= min_rad:
                raise ConflictError(
                    f"laser.focus_{side}_m",
                    getattr(laser, f"focus_{side}_m"),
                    f"to fit, with scanner.aim_error_m {self.scanner.aim_error_m} on either side and two steps of the "
                    f"converter to spare, on display.absorber_{side}_m {getattr(display, f'absorber_{side}_m')}",
                )

    def _check_damping(self) -> None:
        scanner = self.scanner
        # At 1 the two poles coincide, and √(1 − ζ²) divides the bounds of the settling time.
        if scanner.damping * (1.0 + scanner.damping_uncertainty) > DAMPING_MAX:
            expected = f"a half-width that leaves scanner.damping {scanner.damping} at most {DAMPING_MAX}"
            raise ConflictError("scanner.damping_uncertainty", scanner.damping_uncertainty, expected)

    def _check_trajectories(self) -> None:
        if self.scanner.trajectories == "early_steps" and self.board.transport not in CLOCKED_DACS:
            expected = (
                f"steps with board.transport '{self.board.transport}': only on {' and '.join(CLOCKED_DACS)} "
                "do mirrors and light follow one clock"
            )
            raise ConflictError("scanner.trajectories", self.scanner.trajectories, expected)

    def _check_modulation(self) -> None:
        if not self.laser.is_on_off:
            return
        if self.board.is_dac:
            expected = f"'pwm' with board.transport '{self.board.transport}', whose points are too long to make heights"
            raise ConflictError("laser.modulation", self.laser.modulation, expected)
        if self.limits.power_share not in (0.0, 1.0):
            expected = "1 with laser.modulation 'on_off', or 0 for no light"
            raise ConflictError("limits.power_share", self.limits.power_share, expected)

    def _check_converter_codes(self) -> None:
        steps = DAC_HALF_RANGE_CODES if self.board.is_dac else HALF_RANGE_CODES
        if self.scanner.half_range_codes != steps:
            expected = f"{steps}, the converter's steps behind board.transport '{self.board.transport}'"
            raise ConflictError("scanner.half_range_codes", self.scanner.half_range_codes, expected)

    def _check_interface(self) -> None:
        if self.scanner.feedback and self.board.is_dac:
            expected = f"false, as board.transport '{self.board.transport}' measures no mirrors"
            raise ConflictError("scanner.feedback", "true", expected)
        if self.scanner.interface == "analog":
            return
        if self.board.is_dac:
            expected = f"analog, as board.transport '{self.board.transport}' has it"
            raise ConflictError("scanner.interface", self.scanner.interface, expected)
        if self.scanner.delay_s < XY2_100_DELAY_S:
            expected = f"at least {XY2_100_DELAY_S:g}, two frames of scanner.interface 'xy2-100'"
            raise ConflictError("scanner.delay_s", self.scanner.delay_s, expected)

    def list_stage_configs(self) -> tuple["Config", ...]:
        """Return one configuration per stage, whose sections and only stage are its own, or itself without stages."""
        if not self.stages:
            return (self,)
        sections = ("laser", "scanner", "board")
        return tuple(
            # Copied without validation: the parts were validated, and the whole is checked by its owner.
            self.model_copy(update={"stages": (stage,)} | {name: getattr(stage, name) for name in sections})
            for stage in self.stages
        )

    @property
    def lasers(self) -> tuple[LaserSection, ...]:
        """The laser of each stage."""
        return tuple(stage.laser for stage in self.stages) or (self.laser,)

    def find_exchangeable_boards(self) -> str | None:
        """Return a sentence that names the stages whose boards may change places, None if none may.

        The kernel numbers ports in the order in which they appear, and a board is recognised by its uid alone.
        """
        boards = {stage.name: stage.board for stage in self.stages if stage.board.is_numbered and not stage.board.uid}
        if len(self.stages) < 2 or not boards:
            return None
        named = ", ".join(f"{name!r} on {board.port}" for name, board in boards.items())
        return f"the numbers of ports change with each plug and start, and a stage may get another's board: {named}"

    @property
    def lease_s(self) -> float:
        """Longest time after the last lease until a board closes its gate, s."""
        return max(stage.board.lease_s for stage in self.list_stage_configs())

    @property
    def stream_lead_s(self) -> float:
        """Time for which points of a stream are sent ahead, s."""
        return max(stage.board.stream_lead_s for stage in self.list_stage_configs())

    def read_from(self, path: Path) -> Self:
        """Return the configuration as that of a file, which `name_file` names."""
        named = self.model_copy()
        named._file = str(path)
        return named

    @contextmanager
    def name_file(self) -> Iterator[None]:
        """Add the configuration's file to an InputError of the block that names one of its keys."""
        try:
            yield
        except InputError as error:
            if not self._file or error.where.partition(".")[0] not in type(self).model_fields:
                raise
            raise InputError(f"{self._file}: {error.where}", error.value, error.expected, error.code) from None

    def select_stage(self, name: str | None) -> "Config":
        """Return the configuration of a stage by name, None for the only one. Raise InputError for an unknown name."""
        if name is None and len(self.stages) < 2:
            return self
        for stage, config in zip(self.stages, self.list_stage_configs(), strict=False):
            if stage.name == name:
                return config
        names = ", ".join(stage.name for stage in self.stages)
        raise InputError(
            "--stage",
            MISSING if name is None else name,
            f"one of {names}" if names else "none: the display has one stage",
        )

    @property
    def reach(self) -> BoolArray:
        """Whether the beam of the only stage reaches each pixel, [p]."""
        layout = build_pixel_layout(self.display)
        within = np.ones(len(layout), dtype=np.bool_)
        if self.stages:
            for places, span in ((layout.row, self.stages[0].rows), (layout.column, self.stages[0].columns)):
                if span is not None:
                    within &= (places >= span[0]) & (places <= span[1])
        return within

    @property
    def min_power_w(self) -> float:
        """Power of the weakest pulse: of the smallest duty step that reaches the laser's threshold, W."""
        if self.laser.is_on_off:
            return self.laser.max_power_w
        laser, steps = self.laser, DAC_POWER_STEPS.get(self.board.transport, POWER_STEPS)
        # A DAC that may play slower emits less power for longer, and that power must reach the threshold.
        return self.board.stretch * find_min_power_w(laser.max_power_w, laser.curve, laser.threshold_w, steps)

    @property
    def tolerance_rad(self) -> tuple[float, float]:
        """Largest errors of mirrors x and y with the whole focus on the absorber, rad."""
        display, laser, scanner = self.display, self.laser, self.scanner
        margin_m = (
            (display.absorber_width_m - laser.focus_width_m) / 2.0 - scanner.aim_error_m,
            (display.absorber_height_m - laser.focus_height_m) / 2.0 - scanner.aim_error_m,
        )
        return margin_m[0] / (2.0 * scanner.focal_length_m), margin_m[1] / (2.0 * scanner.focal_length_m)


@dataclass(frozen=True, eq=False, repr=False)
class PixelLayout(ReadOnlyArrays):
    """Pixel positions [p], m, from the optical axis, x to the right, y up. Indices count by rows from the bottom."""

    x_m: FloatArray
    y_m: FloatArray
    row: IntArray
    column: IntArray

    def __len__(self) -> int:
        return len(self.x_m)

    def __repr__(self) -> str:
        return (
            f"<PixelLayout: {len(self)} pixels, {int(self.row.max()) + 1} rows × {int(self.column.max()) + 1} columns>"
        )


def build_pixel_layout(display: DisplaySection) -> PixelLayout:
    """Compute the pixel positions of a lattice. Missing places have no index."""
    missing = set(display.missing)
    places = [
        (row, column)
        for row in range(display.rows)
        for column in range(display.columns)
        if (row, column) not in missing
    ]
    row, column = np.array(places, dtype=np.int64).T
    return PixelLayout(
        x_m=(column - (display.columns - 1) / 2) * display.pitch_m,
        y_m=(row - (display.rows - 1) / 2) * display.pitch_m,
        row=row.copy(),
        column=column.copy(),
    )
