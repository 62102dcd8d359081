"""The configuration with everything derived from it filled in."""

from typing import Any

from optodrive.planning.display_model import DisplayModel


def build_effective_config(display: DisplayModel) -> dict[str, Any]:
    """`optodrive config show --json`: sections as configured, pixels' places, a move's time, the model's numbers."""
    config, layout = display.config, display.layout
    resolved = config.model_dump(mode="json")
    resolved["display"]["pixels"] = [
        {"index": index, "x_m": x_m, "y_m": y_m, "bridge_width_m": config.display.bridge_width_m}
        for index, (x_m, y_m) in enumerate(zip(layout.x_m.tolist(), layout.y_m.tolist(), strict=True))
    ]
    moves = display.scan_head.settling
    resolved["scanner"]["move_pitch_s"] = (
        moves.settling_us(moves.pitch_rad, moves.pitch_rad, moves.long_dwell_us) * 1e-6
    )
    pixel = display.parameters.build_pixel(config.display.bridge_width_m)
    resolved["pixel_model"].update(
        {
            "R": pixel.r_k_per_w,
            "C": pixel.c_j_per_k,
            "epsilon": pixel.epsilon,
            "tau_g": pixel.tau_g_s,
            "kappa": pixel.kappa_m_per_k,
            "phi": pixel.phi_n_per_k,
            "planner_terms": {key: display.parameters.term_values(key) for key in display.parameters.planner_terms},
            "units": {"R": "K/W", "C": "J/K", "epsilon": "1", "tau_g": "s", "kappa": "m/K", "phi": "N/K"},
        }
    )
    return resolved
