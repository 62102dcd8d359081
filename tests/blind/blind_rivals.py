"""Distinguishability by an ideal analysis: the residual in σ when each catalogue cause is fitted instead.

Each cause is tried with a free amplitude and a grid of time constants, base parameters refitted; a cause that leaves
only a few σ is a rival that this data cannot exclude. Takes some seconds.

    compute_case_rivals(case) -> {cause: residual σ}, in ascending order; "" is the nominal model alone
"""

from __future__ import annotations

from blind_causes import CATALOGUE
from blind_display import MIRRORS, Physics
from blind_noise import subtract_signals
from blind_session import Instruments, Run, build_bench, build_scene, simulate_ideal_rises


def _trials(base: Physics, runs: list[Run]) -> list[tuple[str, dict[str, object]]]:
    scene = build_scene(base, runs)
    peak = scene.base.kappa * scene.peak_gas_k
    trials: list[tuple[str, dict[str, object]]] = [
        ("bridge_conductivity", {"bridge": "mean", "bridge_n": n}) for n in (0.1, 0.6)
    ]
    trials += [("heat_capacity", {"capacity": "linear", "capacity_c": c}) for c in (0.03, 0.2)]
    trials += [("radiation", {"radiating": a}) for a in (1e-6, 5e-6)]
    trials += [("wall_heating", {"wall_r": 5.0, "wall_c": t / 5.0}) for t in (0.1, 0.2, 0.5, 1.5, 5.0, 10.0)]
    trials += [("neighbour_crosstalk", {"crosstalk": 0.02, "crosstalk_lag": t}) for t in (0.0, 0.03, 0.1)]
    trials += [("laser_turn_on", {"turn_on": "exponential", "turn_on_s": t}) for t in (1e-4, 4e-4, 1.2e-3, 3e-3)]
    trials += [
        ("laser_droop", {"droop": (0.05, 0.0), "droop_s": (t, 1.0), "droop_by_power": by})
        for t in (3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0)
        for by in (False, True)
    ]
    trials += [("power_nonlinearity", {"power": "threshold", "power_size": 0.1})]
    trials += [("power_nonlinearity", {"power": "curvature", "power_size": 0.1})]
    trials += [("sensor_lag", {"sensor": "first_order", "sensor_s": t}) for t in (1e-4, 4e-4, 1.2e-3, 3e-3)]
    trials += [("membrane_creep", {"creep": (0.1,), "creep_s": (t,)}) for t in (0.01, 0.03, 0.1, 0.3, 1.0)]
    trials += [("membrane_stiffening", {"stiff": "cubic", "stiff_m": x * peak}) for x in (1.2, 4.0)]
    trials += [("gas_leak", {"leak": t}) for t in (0.1, 1.0, 4.0, 10.0)]
    trials += [
        ("absorber_ageing", {"ageing": form, "ageing_loss": 0.05, "ageing_dose": scene.dose_j})
        for form in ("linear", "saturating")
    ]
    stray = {"stray": 0.1, "wall_r": 3.0, "wall_c": 0.1, "wall_takes_flow": 0.0}
    trials += [("beam_misalignment", {"stray_pixel": p, **stray}) for p in scene.pixels]
    room = {"room_k": 1.0, "room_session_s": scene.session_s}
    trials += [("ambient_drift", {"room": "ramp", **room})]
    trials += [("ambient_drift", {"room": "sine", "room_phase": f, **room}) for f in (0.0, 1.57)]
    for which in (*scene.signals, "all"):
        names = (*scene.signals, *MIRRORS) if which == "all" else (which,)
        trials += [("clock_offset", {"clock_s": dict.fromkeys(names, t)}) for t in (-1e-3, -2e-4, 2e-4, 1e-3)]
    if any(run.experiment.commands is not None for run in runs):
        trials += [("mirror_lag", {"mirror_hz": hz, "mirror_zeta": 0.7}) for hz in (400.0, 1000.0, 2500.0)]
    return trials


def compute_rivals(base: Physics, instruments: Instruments, runs: list[Run], truth: Physics) -> dict[str, float]:
    """Return the residual in σ after the best fit of each catalogue cause, in ascending order."""
    bench = build_bench(base, instruments, runs)
    shown = simulate_ideal_rises(base, runs, truth)
    nothing = simulate_ideal_rises(base, runs, base)
    left = {"": bench.sigma(shown)} | dict.fromkeys(CATALOGUE, float("inf"))
    left["sensor_scale"] = left[""]
    for key, changes in _trials(base, runs):
        column = subtract_signals(simulate_ideal_rises(base, runs, base.with_(**changes)), nothing)
        left[key] = min(left[key], bench.sigma(shown, refits=2, extras=(column,)))
    return dict(sorted(left.items(), key=lambda item: item[1]))


def compute_case_rivals(case) -> dict[str, float]:
    """Return the rivals of a drawn case."""
    return compute_rivals(Physics(**case.base), case.instruments, case.runs, case.truth)
