"""Configuration files: shipped ones, loading, and the measured servo that a configuration may name."""

import os
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from optodrive.core.errors import InputError
from optodrive.core.plausibility import PlausibleRange, check_table, collect_ranges
from optodrive.core.toml_model import Section, check_format, parse_table, read_toml, validate_table
from optodrive.device.config import FORMAT, VERSION, Config
from optodrive.device.config_sections import ServoSection

MIRRORS_FORMAT = "optodrive-mirrors"
MIRRORS_VERSION = 1
DEFAULT_CONFIG = "display-437"


def locate_shipped(*parts: str) -> Path:
    """Return the path of a file that ships with the package, in the wheel or in the source tree."""
    package = Path(str(files("optodrive")))
    installed = package / "_shipped" / "configs"
    return (installed if installed.is_dir() else package.parent / "configs").joinpath(*parts)


def list_shipped_configs() -> list[str]:
    """Return the names of the shipped configurations."""
    return sorted(path.stem for path in locate_shipped().glob("display-*.toml"))


def load_config(source: str | Path | None = None, measured_servo: bool = True) -> Config:
    """Read a configuration file, or a shipped one by its name. Raise InputError with one line.

    measured_servo: apply the file of measured servos that the configuration names
    """
    source = DEFAULT_CONFIG if source is None else source
    path = Path(source)
    if not os.path.exists(path):  # noqa: PTH110 - Path.exists raises for a path that is too long
        if str(source) not in list_shipped_configs():
            expected = "a file, which `optodrive config new` writes, or " + ", ".join(list_shipped_configs())
            raise InputError("--config", str(source), expected)
        path = locate_shipped(f"{source}.toml")
    config = build_config(path, read_toml(path))
    return _apply_measured_servos(config) if measured_servo else config


def build_config(path: Path, table: dict[str, Any]) -> Config:
    """Build the configuration of a file's table, with the servo that it states. Raise InputError with one line."""
    check_format(path, table, FORMAT, VERSION)
    check_table(str(path), table, collect_ranges(Config))
    for section, key in list_named_files(table):
        # Relative to the file and not to the working directory: a service and a shell must read the same field.
        section[key] = str(path.parent / section[key])
    config = validate_table(path, table, Config).read_from(path)
    return config.list_stage_configs()[0] if len(config.stages) == 1 else config


def _apply_measured_servos(config: Config) -> Config:
    """Return the configuration with the servos that it names, of every stage, and the smallest galvo cap they leave."""
    if len(config.stages) < 2:
        mirrors = config.scanner.mirrors
        return config if mirrors is None else apply_measured_servo(config, Path(mirrors))
    measured = [_apply_measured_servos(each.model_copy(update={"stages": ()})) for each in config.list_stage_configs()]
    stages = tuple(
        stage.model_copy(update={"scanner": each.scanner}) for stage, each in zip(config.stages, measured, strict=True)
    )
    # One cap for all stages: the smallest that a measured servo leaves.
    cap = min(each.limits.galvo_acceleration_rms_max_rad_per_s2 for each in measured)
    limits = config.limits.model_copy(update={"galvo_acceleration_rms_max_rad_per_s2": cap})
    return config.model_copy(update={"stages": stages, "limits": limits})


def list_named_files(table: dict[str, Any]) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield each section, and its key, that names another file, relative to the configuration's folder.

    A parameter set is a file only with the suffix .toml.
    """
    stages = table.get("stages")
    named = [
        (table.get("display"), "pixel_map"),
        (table.get("display"), "sensitivity_map"),
        (table.get("pixel_model"), "parameters"),
    ]
    for part in (table, *(stages if isinstance(stages, list) else ())):
        if isinstance(part, dict):
            named += [(part.get("scanner"), "field"), (part.get("scanner"), "mirrors")]
    for section, key in named:
        if not isinstance(section, dict):
            continue
        name = section.get(key)
        if isinstance(name, str) and name and (key != "parameters" or name.endswith(".toml")):
            yield section, key


class GalvoSection(Section):
    """Correction of the galvo cap for mirrors that accelerate more than the common servo."""

    share: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Remaining fraction of the cap."""


_RestingError = Annotated[float, Field(ge=0), PlausibleRange(0.0, 0.1, "rad")]


class EffectSection(Section):
    """Error of either mirror that no settling time removes, because the mirror has a nonlinear effect."""

    name: tuple[str, str]
    """Effect of mirrors x and y."""
    error_rad: tuple[_RestingError, _RestingError]
    """Largest error that stays after a move of mirrors x and y, rad."""


class MirrorsFile(Section):
    """The file mirrors.toml as `optodrive calibrate servo` writes it. The tables about and axes are informative."""

    format: Literal["optodrive-mirrors"]
    version: Literal[1]
    scanner: ServoSection
    galvo: GalvoSection = GalvoSection()
    effect: EffectSection | None = None
    about: dict[str, Any] = Field(default_factory=dict)
    axes: dict[str, Any] = Field(default_factory=dict)


def apply_measured_servo(config: Config, path: Path) -> Config:
    """Return the configuration with measured servos and the galvo cap that they leave. Raise InputError."""
    table = read_toml(path)
    check_format(path, table, MIRRORS_FORMAT, MIRRORS_VERSION)
    measured = parse_table(path, table, MirrorsFile)
    scanner = config.scanner.model_copy(update={**measured.scanner.model_dump(), "mirrors": str(path)})
    if measured.effect is not None:
        # An error that stays counts as aim: scheduler and limiter need no other model of the mirror.
        scanner = scanner.model_copy(update={"aim_error_m": _bound_aim_error_m(config, measured.effect, path)})
    stated = config.limits.galvo_acceleration_rms_max_rad_per_s2
    cap = {"galvo_acceleration_rms_max_rad_per_s2": stated * measured.galvo.share}
    return config.model_copy(update={"scanner": scanner, "limits": config.limits.model_copy(update=cap)})


def _bound_aim_error_m(config: Config, effect: EffectSection, path: Path) -> float:
    """Return the aim error including the rest of an effect, or raise InputError if the gate would never open."""
    for axis, (name, error_rad, tolerance_rad) in enumerate(
        zip(effect.name, effect.error_rad, config.tolerance_rad, strict=True)
    ):
        if error_rad + 2.0 * config.scanner.rad_per_code >= tolerance_rad:
            expected = (
                f"below the gate's tolerance of {tolerance_rad:.3g}: {name} of mirror {'xy'[axis]} leaves an error "
                "that no settling time removes"
            )
            raise InputError(f"{path}: effect.error_rad", error_rad, expected)
    return config.scanner.aim_error_m + 2.0 * config.scanner.focal_length_m * max(effect.error_rad)
