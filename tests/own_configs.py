"""Configurations of displays that nobody has built, and stimuli that they can show."""

import json
from math import log

import numpy as np
from hypothesis import strategies as st

from optodrive.core.quantity import m_to_um


@st.composite
def log_uniform(draw, low, high):
    """Draw a number between two positive ones, each decade as often as another."""
    return float(np.exp(draw(st.floats(log(low), log(high)))))


ONE = st.just(1)


@st.composite
def tables(draw, stages=ONE):
    """Draw the table of a configuration. A few of them are not valid, and then one line must say so.

    stages: strategy of the number of stages
    """
    rows, columns = draw(st.sampled_from([(1, 1), (6, 6), (2, 7)])), draw(st.integers(1, 6))
    rows, columns = (rows[0], rows[1]) if draw(st.booleans()) else (draw(st.integers(1, 6)), columns)
    pitch_m = draw(log_uniform(1.5e-3, 12e-3))
    absorber_m = [pitch_m * draw(st.floats(0.3, 0.95)) for _ in "xy"]
    focus_m = [each * draw(st.floats(0.1, 0.7)) for each in absorber_m]
    margin_m = min(each - light for each, light in zip(absorber_m, focus_m, strict=True)) / 2.0
    focal_m = draw(log_uniform(0.04, 0.8))
    reach_rad = max(rows, columns, 2) * pitch_m / (4.0 * focal_m)
    width_s = draw(st.sampled_from([0.05, 0.02, 1e-3])) if draw(st.booleans()) else draw(log_uniform(1e-3, 0.065))
    power_w = draw(st.sampled_from([1.2, 2.45])) if draw(st.booleans()) else draw(log_uniform(0.05, 8.0))
    pixel_w = power_w * draw(st.floats(0.1, 1.0))
    ambient_c = draw(st.floats(0.0, 40.0))
    bandwidth_hz, damping = draw(log_uniform(300.0, 1e4)), draw(st.floats(0.3, 0.9))
    slew_rad_per_s = draw(log_uniform(5.0, 500.0))
    table = {
        "format": "optodrive-config",
        "version": 1,
        "name": "own",
        "ambient_c": ambient_c,
        "display": {
            "rows": rows,
            "columns": columns,
            "pitch_m": pitch_m,
            "bridge_width_m": draw(log_uniform(1e-4, 1e-3)),
            "absorber_width_m": absorber_m[0],
            "absorber_height_m": absorber_m[1],
        },
        "pixel_model": {"parameters": draw(st.sampled_from(["surroundings", "calibrated", "paper_s1_literal"]))},
        "laser": {
            "max_power_w": power_w,
            "pwm_hz": draw(log_uniform(max(100.0, 1.01 / width_s), 1e5)),
            "focus_width_m": focus_m[0],
            "focus_height_m": focus_m[1],
        },
        "scanner": {
            "focal_length_m": focal_m,
            "range_rad": min(0.78, reach_rad * draw(log_uniform(1.02, 8.0))),
            "bandwidth_hz": bandwidth_hz,
            "damping": damping,
            "delay_s": draw(st.sampled_from([0.0, 3e-5, 1e-3])),
            "slew_rad_per_s": slew_rad_per_s,
            "aim_error_m": margin_m * draw(st.floats(0.01, 0.9)),
        },
        "limits": {
            "absorber_max_c": 200.0 + draw(st.integers(0, 30)) * 10.0,
            "wall_max_c": ambient_c + draw(st.floats(5.0, 100.0)),
            "touch_max_c": ambient_c + draw(st.floats(3.0, 40.0)),
            # A little above the load of one long move, or much above it.
            "galvo_acceleration_rms_max_rad_per_s2": slew_rad_per_s
            * (2.0 * np.pi * bandwidth_hz / damping) ** 0.5
            * draw(log_uniform(1.4, 30.0)),
            "galvo_mean_s": draw(log_uniform(0.5, 5.0)),
            "pulse_energy_max_j": draw(log_uniform(5e-3, 0.3)),
            "pulse_width_max_s": width_s,
            "pulse_gap_min_s": draw(log_uniform(1e-5, 0.01)),
            "pixel_mean_power_max_w": pixel_w,
            "pixel_mean_window_s": draw(st.sampled_from([0.1, 1.0, 10.0])),
            "display_mean_power_max_w": pixel_w * draw(st.floats(1.0, 3.0)),
            "display_mean_window_s": draw(st.sampled_from([0.1, 10.0])),
            "power_share": draw(st.sampled_from([1.0, 0.4])),
        },
        "board": {
            "transport": "simulated",
            "baud": draw(st.sampled_from([1_000_000, 115_200])),
            "lease_s": draw(log_uniform(0.02, 1.0)),
            "stream_lead_s": draw(log_uniform(0.01, 0.2)),
        },
    }
    table["limits"]["absorber_max_c"] = max(table["limits"]["absorber_max_c"], table["limits"]["wall_max_c"])
    if rows * columns > 2 and draw(st.booleans()):
        places = [[row, column] for row in range(rows) for column in range(columns)]
        table["display"]["missing"] = draw(
            st.lists(st.sampled_from(places), min_size=1, max_size=rows * columns // 2, unique_by=tuple)
        )
    if draw(st.booleans()):
        names = ("absorbed_power", "bridge_resistance", "wall_capacity", "gas_lag", "touch_share")
        table["limits"]["uncertainty"] = {name: draw(st.floats(0.0, 0.3)) for name in names}
    if draw(st.booleans()):
        table["panel"] = {"resistance_k_per_w": draw(log_uniform(1.0, 300.0))}
    if draw(stages) == 2:
        table["stages"] = [
            {"name": "left", "laser": {"max_power_w": power_w}},
            {"name": "right", "laser": {"max_power_w": 0.7 * power_w}},
        ]
    return table


def write_config(path, table):
    """Write the table as TOML, whose values are those of JSON, and return the path."""
    lines = []

    def add(values, head):
        lines.extend(f"{key} = {json.dumps(value)}" for key, value in values.items() if not is_table(value))
        for key, value in values.items():
            name = f"{head}{key}"
            for each in value if is_table(value) and isinstance(value, list) else [value] * isinstance(value, dict):
                lines.append(f"[[{name}]]" if isinstance(value, list) else f"[{name}]")
                add(each, f"{name}.")

    add(table, "")
    path.write_text("\n".join(lines) + "\n")
    return path


def is_table(value):
    """Return whether a value is a table or a list of tables."""
    return isinstance(value, dict) or (isinstance(value, list) and bool(value) and isinstance(value[0], dict))


@st.composite
def frames(draw, display):
    """Draw frames and a train that the display's pixels can reach, and that its limits may trim."""
    config, top_um = display.config, m_to_um(display.max_displacement_m)
    pixels = draw(st.lists(st.integers(0, len(top_um) - 1), min_size=1, max_size=min(3, len(top_um)), unique=True))
    share = draw(st.sampled_from([0.3, 0.6, 0.9]))
    target_um = {str(pixel): min(150.0, share * float(top_um[pixel])) for pixel in pixels}
    shown = [{"show_at_s": at_s, "duration_s": 0.2, "target_um": target_um} for at_s in (0.0, 0.5)]
    periods = max(1, int(0.4 * config.limits.pulse_width_max_s * config.laser.pwm_hz))
    train = {
        "pixel": pixels[0],
        "start_s": 1.2,
        "duration_s": 0.2,
        "pulse_width_s": periods / config.laser.pwm_hz,
        "gap_s": max(0.02, 2.0 / config.laser.pwm_hz),
        "power_w": 0.6 * min(each.laser.max_power_w for each in config.list_stage_configs()),
    }
    return {"frames": shown if max(target_um.values()) > 1.0 else [], "trains": [train]}
