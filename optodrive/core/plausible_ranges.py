"""Ranges of absolute values that are plausible in recordings and sequences.

Those of a TOML file stand at the fields of its models. A place is the dotted key, without the indices of lists. A
longest time of a day refuses nothing by itself: times are judged against each other, or against the response.
"""

from optodrive.core.plausibility import PlausibleRange

TEMPERATURE = PlausibleRange(150.0, 3000.0, "K")
MIRROR_ANGLE = PlausibleRange(0.0, 0.9, "rad")
DAY = PlausibleRange(0.0, 86_400.0, "s")

RECORDING = {
    "ambient_K": PlausibleRange(150.0, 600.0, "K"),
    "bridge_width_m": PlausibleRange(1e-5, 5e-3, "m"),
    "aim_x_m": PlausibleRange(0.0, 5e-3, "m"),
    "aim_y_m": PlausibleRange(0.0, 5e-3, "m"),
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
}
FRAMES = {
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
}
