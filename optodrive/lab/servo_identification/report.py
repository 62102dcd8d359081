"""Report of two identified mirrors: as data, as text lines, and as mirrors.toml."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.core.files import write_text
from optodrive.core.quantity import format_quantity
from optodrive.device.config import Config
from optodrive.device.config_file import MIRRORS_FORMAT, MIRRORS_VERSION
from optodrive.device.gate_timing import build_servo, settling_s
from optodrive.device.servo import Servo
from optodrive.lab.inference.sentences import describe_sufficiency
from optodrive.lab.servo_identification.effect_fit import LINEAR, Linearity
from optodrive.lab.servo_identification.effects import LABELS, SLEW_LIMIT
from optodrive.lab.servo_identification.gate import CommonServo, MirrorEffect, Mirrors, find_half_widths, move_sizes_rad
from optodrive.lab.servo_identification.identify import IdentifiedServo
from optodrive.lab.servo_identification.records import AXES

INTERVAL_SIGMAS = 1.96
"""Half-width of a 95 % interval."""
STEP_TOLERANCE = 0.02
"""Usual tolerance of a settling time, relative to the step."""
RELATIVE_TOLERANCE = 0.05
"""Step sizes that differ by less are reported as one."""
SIZES_MAX = 6
BANDWIDTH_TOLERANCE, DELAY_TOLERANCE_S, SETTLING_TOLERANCE = 0.03, 1e-5, 0.05
MISFIT_MAX = 1.5
"""A residual above this multiple of the noise shows an unmodelled response."""
CRITICAL_DAMPING = 0.99
HALF_WIDTHS = ("bandwidth_uncertainty", "damping_uncertainty", "slew_uncertainty", "delay_uncertainty_s")
"""Keys of the half-widths in the configuration's [scanner]."""


def build_report(
    mirrors: Mirrors, common: CommonServo, config: Config, effects: tuple[MirrorEffect, MirrorEffect]
) -> dict[str, Any]:
    """Build the report in SI units. Intervals are 95 %."""
    axes = [_axis_report(mirror, config, effect.linearity) for mirror, effect in zip(mirrors, effects, strict=True)]
    half_widths = dict(zip(HALF_WIDTHS, find_half_widths(mirrors, common.servo), strict=True))
    own = (_axis_remarks(mirror, axis["settling"], config) for mirror, axis in zip(mirrors, axes, strict=True))
    of_effects = (_effect_remarks(row, effect, config.tolerance_rad[row]) for row, effect in enumerate(effects))
    remarks = [remark for part in (*own, _common_servo_remarks(mirrors, common), *of_effects) for remark in part]
    return {
        "scanner": scanner_table(common.servo) | half_widths,
        "galvo": {"share": common.galvo_share},
        "settling_excess": dict(zip(AXES, common.settling_excess, strict=True)),
        "effect": {"name": [each.name for each in effects], "error_rad": [each.error_rad for each in effects]},
        "axes": dict(zip(AXES, axes, strict=True)),
        "remarks": remarks,
    }


def report_linearity(linearity: Linearity) -> dict[str, Any]:
    """Return the claim with its sentences, probabilities, and the rms misfits of the best forms in units of noise."""
    lines = describe_sufficiency(linearity.claim, linearity.probabilities, "One linear servo", LABELS)
    return {
        "verdict": linearity.claim.verdict,
        "effects": list(linearity.claim.causes),
        "sentences": lines,
        "probability": linearity.probability,
        "misfit": {name: float(np.sqrt(each.misfit2)) for name, each in linearity.fits.items()},
        "form": {name: each.servo.form.name for name, each in linearity.fits.items()},
        "gain": linearity.gain,
    }


def describe_linearity(report: dict[str, Any]) -> list[str]:
    """Return the claim, and how well the form that it names fits, as lines."""
    headline, *reasons = report["sentences"]
    misfit = report["misfit"]
    fitted = ((report["form"][name], misfit[name]) for name in report["effects"])
    fits = [f"{form}: {own:.3g} × noise, linear {misfit[LINEAR]:.3g}" for form, own in fitted]
    if report["effects"] == [SLEW_LIMIT]:
        # A slew limit is part of every servo: the name is no call for action.
        headline += " The identified servo states it."
    return [" ".join([headline, *(f"{each}." for each in fits)]), *reasons]


def _effect_remarks(row: int, effect: MirrorEffect, tolerance_rad: float) -> list[str]:
    if effect.error_rad == 0.0:
        return []
    error, tolerance = (format_quantity(each, "rad") for each in (effect.error_rad, tolerance_rad))
    consequence = "no settling time opens the gate, and plans refuse this file"
    if effect.error_rad < tolerance_rad:
        consequence = "plans keep it as aim error"
    found = f"{effect.name} leaves an error of up to {error} of the gate's tolerance of {tolerance}"
    return [f"{AXES[row]}: {found}: {consequence}"]


def scanner_table(servo: Servo) -> dict[str, float]:
    """Return a servo under the keys of the configuration's [scanner]."""
    stated = servo.frequency, servo.damping, servo.delay, servo.slew
    return dict(zip(("bandwidth_hz", "damping", "delay_s", "slew_rad_per_s"), stated, strict=True))


def format_report_lines(report: dict[str, Any]) -> list[str]:
    """Format the report as text lines."""
    lines = []
    for name, axis in report["axes"].items():
        low, high = axis["bandwidth_interval_hz"]
        slew = f"{axis['slew_rad_per_s']:.4g} rad/s" if axis["slew_identified"] else "not identified"
        lines += [
            f"mirror {name}         bandwidth {axis['bandwidth_hz']:.1f} Hz ({low:.1f} to {high:.1f}), damping "
            f"{axis['damping']:.3f} ± {axis['damping_half_width']:.3f}, delay {1e6 * axis['delay_s']:.1f} ± "
            f"{1e6 * axis['delay_half_width_s']:.1f} µs, slew {slew}",
            f"                 residual {1e6 * axis['residual_rad']:.1f} µrad rms, "
            f"noise {1e6 * axis['noise_rad']:.1f}; "
            f"gain {axis['gain']:.4f}; {axis['steps']} steps",
            *(f"                 {line}" for line in describe_linearity(axis["linearity"])),
        ]
        for row in axis["settling"]:
            lines.append(f"  step {1e3 * row['step_rad']:8.3f} mrad  " + _describe_settling(row))
    scanner = report["scanner"]
    lines.append("[scanner]        " + ", ".join(f"{key} = {value:.5g}" for key, value in scanner.items()))
    return lines + [f"note             {remark}" for remark in report["remarks"]]


def write_mirrors(path: Path, report: dict[str, Any], source: str) -> None:
    """Write mirrors.toml atomically. source: description of the recording."""
    printable = "".join(letter for letter in source if letter.isprintable() and letter not in '"\\')
    effect = report["effect"]
    text = [f'format = "{MIRRORS_FORMAT}"', f"version = {MIRRORS_VERSION}", "", "[about]", f'source = "{printable}"']
    text += ["", "[scanner] # for both mirrors, instead of the configuration's", *_format_pairs(report["scanner"])]
    text += ["", "[galvo] # factor on the galvo cap, for the faster mirror", *_format_pairs(report["galvo"])]
    if any(error_rad > 0.0 for error_rad in effect["error_rad"]):
        names = ", ".join(f'"{name}"' for name in effect["name"])
        text += ["", "[effect] # of x and y: what stays after a move, beyond the servo", f"name = [{names}]"]
        text += [f"error_rad = {effect['error_rad']!r}"]
    for name, axis in report["axes"].items():
        text += ["", f"[axes.{name}] # as measured, for information", *_format_pairs(axis)]
    write_text(path, "\n".join(text) + "\n")


def _format_pairs(table: dict[str, Any]) -> list[str]:
    numbers = ((key, value) for key, value in table.items() if isinstance(value, int | float))
    return [f"{key} = {str(value).lower() if isinstance(value, bool) else repr(value)}" for key, value in numbers]


def _axis_report(mirror: IdentifiedServo, config: Config, linearity: Linearity) -> dict[str, Any]:
    servo, half_widths = mirror.servo, INTERVAL_SIGMAS * mirror.sigma
    inverse = 1.0 / servo.slew + half_widths[3] * np.array([1.0, -1.0])
    return {
        **scanner_table(servo),
        "bandwidth_interval_hz": (servo.frequency * np.exp(half_widths[0] * np.array([-1.0, 1.0]))).tolist(),
        "damping_half_width": float(half_widths[1]),
        "delay_half_width_s": float(half_widths[2]),
        "slew_identified": mirror.slew_identified,
        "slew_interval_rad_per_s": (1.0 / inverse[inverse > 0.0]).tolist() if mirror.slew_identified else None,
        "gain": mirror.gain,
        "offset_rad": mirror.offset_rad,
        "residual_rad": mirror.residual_rad,
        "noise_rad": mirror.trace.noise_rad,
        "steps": len(mirror.trace.steps_rad),
        "settling": [_settling_row(mirror, step_rad, config) for step_rad in _list_sizes_rad(mirror, config)],
        "linearity": report_linearity(linearity),
    }


def _distinct_sizes_rad(steps_rad: "np.ndarray[Any, np.dtype[np.float64]]") -> list[float]:
    """Return distinct sizes, at most SIZES_MAX from the smallest to the largest."""
    sizes: list[float] = []
    for step_rad in np.sort(steps_rad).tolist():
        if not sizes or step_rad > (1.0 + RELATIVE_TOLERANCE) * sizes[-1]:
            sizes.append(step_rad)
    rows = np.unique(np.linspace(0, len(sizes) - 1, SIZES_MAX).round().astype(int))
    return [sizes[at] for at in rows]


def _list_sizes_rad(mirror: IdentifiedServo, config: Config) -> list[float]:
    """Return the sizes of a recording's steps, or of the display's moves where it has an excitation."""
    axis = mirror.trace.axis
    return move_sizes_rad(config, axis) if mirror.trace.is_dense else _distinct_sizes_rad(mirror.trace.steps_rad)


def _settling_row(mirror: IdentifiedServo, step_rad: float, config: Config) -> dict[str, Any]:
    configured = build_servo(config.scanner)
    row: dict[str, Any] = {"step_rad": step_rad}
    tolerances_rad = {"gate": config.tolerance_rad[mirror.trace.axis], "share": STEP_TOLERANCE * step_rad}
    for name, tolerance_rad in tolerances_rad.items():
        best_s, low_s, high_s = mirror.settling_s(step_rad, tolerance_rad)
        row[name] = {
            "tolerance_rad": tolerance_rad,
            "measured_s": best_s,
            "interval_s": [low_s, high_s],
            "configured_s": settling_s(configured, step_rad, tolerance_rad),
        }
    return row


def _describe_settling(row: dict[str, Any]) -> str:
    parts = []
    for name, words in (("gate", "gate's tolerance"), ("share", f"{STEP_TOLERANCE:.0%} of the step")):
        each = row[name]
        low, high = (1e3 * value for value in each["interval_s"])
        excess = each["configured_s"] / each["measured_s"] - 1.0
        parts.append(
            f"to {words} in {1e3 * each['measured_s']:.3f} ms ({low:.3f} to {high:.3f}; configured "
            f"{1e3 * each['configured_s']:.3f}, {excess:+.1%})"
        )
    return ", ".join(parts)


def _axis_remarks(mirror: IdentifiedServo, settling: list[dict[str, Any]], config: Config) -> list[str]:
    half_widths, slew = INTERVAL_SIGMAS * mirror.sigma, config.scanner.slew_rad_per_s
    is_wide = half_widths[0] > BANDWIDTH_TOLERANCE or half_widths[2] > DELAY_TOLERANCE_S
    is_critical = mirror.servo.damping + half_widths[1] > CRITICAL_DAMPING
    spread = f"bandwidth ± {half_widths[0]:.1%}, delay ± {1e6 * half_widths[2]:.1f} µs"
    no_slew = f"the slew is not identified, no step was large enough; the configuration's {slew:g} rad/s is kept"
    misfit, parts = f"the residual is {mirror.misfit:.1f} times the noise", "a delay and a slew limit"
    remarks = [
        (not mirror.slew_identified, f"{no_slew}. Settling times of larger moves depend on it"),
        (is_wide, f"large uncertainty: {spread}; measure more steps, or sample faster"),
        (mirror.misfit > MISFIT_MAX, f"{misfit}: the response is not only a second-order servo with {parts}"),
        (is_critical, "critically damped or overdamped within the uncertainty; a configuration is always underdamped"),
    ]
    for row in settling:
        low_s, high_s = row["share"]["interval_s"]
        is_open = high_s - low_s > 2.0 * SETTLING_TOLERANCE * row["share"]["measured_s"]
        step = f"a step of {format_quantity(row['step_rad'], 'rad')} settles within {STEP_TOLERANCE:.0%}"
        after = f"after {1e3 * low_s:.3f} to {1e3 * high_s:.3f} ms: an overshoot near the tolerance, or too few steps"
        remarks.append((is_open, f"{step} {after}"))
    return [f"{AXES[mirror.trace.axis]}: {remark}" for is_due, remark in remarks if is_due]


def _common_servo_remarks(mirrors: Mirrors, common: CommonServo) -> list[str]:
    x, y = (asdict(mirror.servo) for mirror in mirrors)
    difference = max(abs(x[key] - y[key]) / max(x[key], y[key], 1e-12) for key in ("frequency", "damping", "slew"))
    differ = difference > BANDWIDTH_TOLERANCE or max(common.settling_excess) > SETTLING_TOLERANCE
    of_axes = zip(common.settling_excess, AXES, strict=True)
    longer = " and ".join(f"{each:.1%} longer than {axis}" for each, axis in of_axes)
    covers = "one servo model covers both mirrors and settles no sooner than either: at the gate it takes"
    factor = f"the galvo cap is multiplied by {common.galvo_share:.3f}"
    remarks = [f"{covers} {longer}"] if differ else []
    is_faster = common.galvo_share < 1.0 - RELATIVE_TOLERANCE
    return [*remarks, *([f"the faster mirror accelerates more than that model: {factor}"] if is_faster else [])]
