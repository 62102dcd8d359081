"""Plausible ranges of every quantity that a person types or an instrument records, by format and place.

The one exception are the parameters of terms and of patterns, which state their ranges where they are declared. A place
is the dotted key in the file, without the indices of lists.
"""

from optodrive.core.plausibility import PlausibleRange

SERVO = {
    "bandwidth_hz": PlausibleRange(100.0, 1e5, "Hz"),
    "delay_s": PlausibleRange(1e-9, 2e-3, "s"),
    "slew_rad_per_s": PlausibleRange(1.0, 1500.0, "rad/s"),
}
FOCAL_LENGTH = PlausibleRange(5e-3, 3.0, "m")
BRIDGE_WIDTH = PlausibleRange(1e-5, 5e-3, "m")
PITCH = PlausibleRange(1e-4, 0.1, "m")
DISTANCE = PlausibleRange(0.0, 0.5, "m")
PANEL_SIDE = PlausibleRange(1e-3, 3.0, "m")
PIXEL_OFFSET = PlausibleRange(0.0, 5e-3, "m")
SMALL_ANGLE = PlausibleRange(0.0, 0.2, "rad")
MIRROR_ANGLE = PlausibleRange(0.0, 0.9, "rad")
UNCERTAINTY = PlausibleRange(0.0, 0.5, "1")
TEMPERATURE = PlausibleRange(150.0, 3000.0, "K")
DAY = PlausibleRange(0.0, 86_400.0, "s")

STAGE: dict[str, PlausibleRange] = {
    "laser.max_power_w": PlausibleRange(1e-3, 60.0, "W"),
    "laser.pwm_hz": PlausibleRange(50.0, 1e7, "Hz"),
    "laser.focus_width_m": PlausibleRange(1e-6, 0.05, "m"),
    "laser.focus_height_m": PlausibleRange(1e-6, 0.05, "m"),
    "scanner.focal_length_m": FOCAL_LENGTH,
    "scanner.range_rad": PlausibleRange(1e-3, 0.8, "rad"),
    "scanner.aim_error_m": PlausibleRange(1e-9, 5e-3, "m"),
    **{f"scanner.{key}": item for key, item in SERVO.items()},
    "board.lease_s": PlausibleRange(1e-3, 1.0, "s"),
    "board.stream_lead_s": PlausibleRange(1e-3, 0.2, "s"),
}
"""Of the sections that a stage may state for itself."""

RANGES: dict[str, dict[str, PlausibleRange]] = {
    "config": {
        "ambient_c": PlausibleRange(0.0, 60.0, "°C"),
        "display.pitch_m": PITCH,
        "display.bridge_width_m": BRIDGE_WIDTH,
        "display.absorber_width_m": PlausibleRange(5e-5, 0.05, "m"),
        "display.absorber_height_m": PlausibleRange(5e-5, 0.05, "m"),
        "panel.width_m": PANEL_SIDE,
        "panel.height_m": PANEL_SIDE,
        "panel.resistance_k_per_w": PlausibleRange(1e-3, 1e3, "K/W"),
        "panel.capacity_j_per_k": PlausibleRange(0.1, 1e5, "J/K"),
        **STAGE,
        **{f"stages.{key}": item for key, item in STAGE.items()},
        "limits.absorber_max_c": PlausibleRange(1.0, 560.0, "°C"),
        "limits.wall_max_c": PlausibleRange(1.0, 200.0, "°C"),
        "limits.touch_max_c": PlausibleRange(1.0, 90.0, "°C"),
        "limits.galvo_acceleration_rms_max_rad_per_s2": PlausibleRange(1.0, 1e6, "rad/s²"),
        "limits.galvo_mean_s": PlausibleRange(1e-3, 100.0, "s"),
        "limits.pulse_energy_max_j": PlausibleRange(1e-6, 10.0, "J"),
        "limits.pulse_width_max_s": PlausibleRange(1e-7, 0.07, "s"),
        "limits.pulse_gap_min_s": PlausibleRange(1e-9, 0.01, "s"),
        "limits.pixel_mean_power_max_w": PlausibleRange(1e-4, 60.0, "W"),
        "limits.pixel_mean_window_s": PlausibleRange(1e-3, 120.0, "s"),
        "limits.display_mean_power_max_w": PlausibleRange(1e-4, 60.0, "W"),
        "limits.display_mean_window_s": PlausibleRange(1e-3, 120.0, "s"),
        **{
            f"limits.uncertainty.{name}": UNCERTAINTY
            for name in (
                *("absorbed_power", "bridge_resistance", "absorber_capacity", "exponent", "gas_lag"),
                *("wall_resistance", "wall_capacity", "side_resistance", "touch_share", "touch_lag"),
                *("panel_resistance", "panel_capacity"),
            )
        },
        "limits.stage_skew_max_s": PlausibleRange(1e-7, 0.01, "s"),
    },
    "mirrors": {f"scanner.{key}": item for key, item in SERVO.items()},
    "field": {
        "scanner.rad_per_code": PlausibleRange(3e-8, 4e-4, "rad"),
        "scanner.focal_length_m": FOCAL_LENGTH,
        "geometry.offset_x_rad": SMALL_ANGLE,
        "geometry.offset_y_rad": SMALL_ANGLE,
        "geometry.cubic_x_per_rad2": PlausibleRange(0.0, 1e5, "1/rad²"),
        "geometry.cubic_y_per_rad2": PlausibleRange(0.0, 1e5, "1/rad²"),
        "geometry.mirror_distance_m": DISTANCE,
        "geometry.lens_distance_m": DISTANCE,
        "geometry.focal_length_m": FOCAL_LENGTH,
        "geometry.distortion3_per_rad2": PlausibleRange(0.0, 1e5, "1/rad²"),
        "geometry.distortion5_per_rad4": PlausibleRange(0.0, 1e9, "1/rad⁴"),
        "geometry.shift_x_m": PlausibleRange(0.0, 0.05, "m"),
        "geometry.shift_y_m": PlausibleRange(0.0, 0.05, "m"),
        "geometry.turn_rad": PlausibleRange(0.0, 0.5, "rad"),
        "geometry.tilt_x_rad": SMALL_ANGLE,
        "geometry.tilt_y_rad": SMALL_ANGLE,
        "surface.x_m": PIXEL_OFFSET,
        "surface.y_m": PIXEL_OFFSET,
        "uncertainty.sigma_m": PIXEL_OFFSET,
    },
    "pixels": {
        "display.pitch_m": PITCH,
        "map.pixels.offset_x_m": PIXEL_OFFSET,
        "map.pixels.offset_y_m": PIXEL_OFFSET,
        "map.pixels.offset_x_sigma_m": PIXEL_OFFSET,
        "map.pixels.offset_y_sigma_m": PIXEL_OFFSET,
    },
    "pictures": {
        "grid.pitch_m": PlausibleRange(0.2e-3, 0.1, "m"),
        "origin.first_corner_m": DISTANCE,
        "origin.turn_rad": PlausibleRange(0.0, 3.2, "rad"),
    },
    "parameters": {
        "epsilon.value": PlausibleRange(0.02, 1.0, "1"),
        "tau_g.value": PlausibleRange(1e-4, 0.1, "s"),
        "kappa.value": PlausibleRange(1e-7, 1e-4, "m/K"),
        "phi.value": PlausibleRange(1e-5, 5e-3, "N/K"),
        "R_width_product.value": PlausibleRange(5e-3, 1.0, "m K/W"),
        "C_mean.value": PlausibleRange(5e-6, 2e-3, "J/K"),
        "bridge.width_m": BRIDGE_WIDTH,
        "bridge.R.value": PlausibleRange(5.0, 3000.0, "K/W"),
        "bridge.C.value": PlausibleRange(5e-6, 2e-3, "J/K"),
    },
    "recording": {
        "ambient_K": PlausibleRange(150.0, 600.0, "K"),
        "bridge_width_m": BRIDGE_WIDTH,
        "aim_x_m": PIXEL_OFFSET,
        "aim_y_m": PIXEL_OFFSET,
        "pulses.start_s": DAY,
        "pulses.width_s": DAY,
        "pulses.power_W": PlausibleRange(0.0, 60.0, "W"),
        "commands.t_s": DAY,
        "commands.x_rad": MIRROR_ANGLE,
        "commands.y_rad": MIRROR_ANGLE,
        "signal.t_s": DAY,
        "absorber_temperature_K": TEMPERATURE,
        "displacement_m": PlausibleRange(1e-8, 5e-3, "m"),
        "force_N": PlausibleRange(1e-5, 5.0, "N"),
        "mirror_x_rad": MIRROR_ANGLE,
        "mirror_y_rad": MIRROR_ANGLE,
    },
    "spots": {"x_m": DISTANCE, "y_m": DISTANCE},
    "frames": {
        "frames.show_at_s": DAY,
        "frames.duration_s": DAY,
        "frames.target_um": PlausibleRange(1.0, 10_000.0, "µm"),
        "trains.start_s": DAY,
        "trains.duration_s": DAY,
        "trains.pulse_width_s": PlausibleRange(1e-7, 0.07, "s"),
        "trains.gap_s": PlausibleRange(1e-7, 60.0, "s"),
        "trains.period_s": PlausibleRange(1e-6, 60.0, "s"),
        "trains.power_w": PlausibleRange(1e-4, 60.0, "W"),
        "trains.target_um": PlausibleRange(1.0, 10_000.0, "µm"),
        "trains.peak_to_peak_um": PlausibleRange(0.5, 10_000.0, "µm"),
    },
}
"""Ranges of absolute values by format, then by place. A longest time of a day refuses nothing by itself: times are
judged against each other, or against the response."""
