"""Conversion of the display's state, pulses and cap usage to telemetry events."""

from base64 import b64encode
from collections.abc import Iterable
from math import isfinite

import numpy as np

from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.daemon.engine.active_plan import ActivePlan
from optodrive.daemon.responses.telemetry import CapUsage, DisplayEvent, PageEvent, PulseBatch
from optodrive.device.config_sections import LimitsSection
from optodrive.physics.nominal_display import DisplayState
from optodrive.planning.limiter.cap_checks import Usage
from optodrive.planning.limiter.caps import CAPS_BY_KEY

HEIGHT_UNIT_M = 1e-7
TEMPERATURE_UNIT_K = 0.1


def build_display_event(
    board_s: float, warm: bool, state: DisplayState, peaks: DisplayState, ambient_c: float
) -> DisplayEvent:
    """Encode every pixel at a board time, and its peaks since the last event."""
    return DisplayEvent(
        board_s=round(board_s, 6),
        warm=warm,
        height=_encode_base64(state.displacement_m / HEIGHT_UNIT_M),
        height_peak=_encode_base64(peaks.displacement_m / HEIGHT_UNIT_M),
        absorber=_encode_base64((ambient_c + state.absorber_k) / TEMPERATURE_UNIT_K),
        absorber_peak=_encode_base64((ambient_c + peaks.absorber_k) / TEMPERATURE_UNIT_K),
    )


def build_page_event(board_s: float, page_m: FloatArray, limited_by: tuple[str, ...]) -> PageEvent:
    """Encode the heights of the standing page, [p], m, which are all 0 without one, and the caps that limit it."""
    height = _encode_base64(page_m / HEIGHT_UNIT_M) if page_m.any() else ""
    return PageEvent(board_s=round(board_s, 6), height=height, limited_by=list(limited_by))


def build_pulse_batch(
    active: ActivePlan, row: IntArray, start_s: FloatArray, width_s: FloatArray, power_w: FloatArray
) -> PulseBatch:
    """Build a batch from rows [n] of a plan with their times on the board's clock and their powers."""
    plan = active.planned.plan
    return PulseBatch(
        plan=active.record.plan_id,
        name=active.record.name,
        row=row.tolist(),
        pixel=plan.pixel[row].tolist(),
        start_s=_round_values(start_s, 6),
        width_s=_round_values(width_s, 6),
        power_w=_round_values(power_w, 4),
        trimmed_j=_round_values(plan.trimmed_j[row], 6),
        reason=[str(reason) for reason in plan.reason[row]],
    )


def describe_caps(usages: Iterable[Usage], limits: LimitsSection) -> list[CapUsage]:
    """Convert finite caps to display units: temperature in °C, energy in J, power in W, acceleration in rad/s² rms."""
    caps = []
    for usage in usages:
        if not isfinite(usage.limit):
            continue
        cap = CAPS_BY_KEY[usage.cap]
        setting = getattr(limits, cap.setting)
        value, limit = (cap.scale.to_setting(each, usage.limit, setting) for each in (usage.used, usage.limit))
        caps.append(
            CapUsage(
                cap=usage.cap,
                fraction=round(usage.used / usage.limit, 4),
                value=float(f"{value:.5g}"),
                limit=float(f"{limit:.5g}"),
                unit=cap.unit,
                pixel=usage.pixel,
            )
        )
    return caps


def _encode_base64(values: FloatArray) -> str:
    return b64encode(np.clip(np.rint(values), 0, 65535).astype("<u2").tobytes()).decode()


def _round_values(values: FloatArray, digits: int) -> list[float]:
    rounded: list[float] = np.round(values, digits).tolist()
    return rounded
