"""Fit the extended model to one half of the paper's facts and compare it with the other half, term by term.

The first half has the facts that the calibrated set was fitted to, and the temperature of the same pixel; the second
half has the same quantities elsewhere. The models therefore differ by their terms, not by the fitted facts.
"""

import argparse
import json
import sys

import numpy as np
from scipy.optimize import least_squares

from optodrive.lab.validation.outcomes import simulate_outcomes
from optodrive.physics.paper_facts import load_paper_facts
from optodrive.physics.parameters import Parameter, load_parameters

HALVES = {
    "first": ("dT_peak_w020", "z_peak_w020", "dpp_200Hz", "F_peak_w020"),
    "second": ("T_peak_w075", "z_peak_w075", "z_tp8_w040", "F_peak_w055"),
}
JUDGED_FACTS = ("dT_peak_w020", "T_peak_w075", "z_peak_w020", "z_peak_w075", "z_tp8_w040", "F_peak_w020", "F_peak_w055")
JUDGED_FACTS += ("N_50um", "N_400um", "dpp_200Hz", "dpp_law", "slow_law")
MODELS = {
    "nominal": (),
    "bridge_conductivity": ("bridge_conductivity",),
    "gas_membrane": ("gas_membrane",),
    "force_area": ("force_area",),
    "wall_heating": ("wall_heating",),
    "all": ("bridge_conductivity", "gas_membrane", "force_area", "wall_heating", "lateral_conduction", "touch_surface"),
}
FREE_PARAMETERS = {"n": (0.05, 0.0, 1.3), "share": (0.3, 0.1, 0.5), "tau_g": (3.0, 0.3, 30.0), "area": (1.0, 0.1, 7.07)}
FREE_PARAMETERS |= {"kappa": (4.0, 0.5, 20.0), "phi": (0.23, 0.02, 2.0)}
UNITS = {"n": "1", "share": "1", "tau_g": "s", "area": "m^2", "kappa": "m/K", "phi": "N/K"}
UNIT_SCALES = {"tau_g": 1e-3, "area": 1e-6, "kappa": 1e-6, "phi": 1e-3}


def list_free_parameters(terms):
    """Return the free parameters of a model. A term replaces the nominal parameter of its quantity."""
    names = ["share" if "gas_membrane" in terms else "kappa", "tau_g", "area" if "force_area" in terms else "phi"]
    return names + (["n"] if "bridge_conductivity" in terms else [])


def build_parameters(base, terms, values):
    """Build the parameter set of a model from values in the units of FREE_PARAMETERS."""

    def build_parameter(name):
        return Parameter(value=values[name] * UNIT_SCALES.get(name, 1.0), unit=UNITS[name], source="fitted")

    share = build_parameter("share") if "share" in values else Parameter(value=0.3, unit="1", source="assumed")
    chosen_terms = {key: base.terms[key] for key in terms}
    if "bridge_conductivity" in chosen_terms:
        chosen_terms["bridge_conductivity"] = {"exponent": build_parameter("n")}
    if "gas_membrane" in chosen_terms:
        chosen_terms["gas_membrane"] = chosen_terms["gas_membrane"] | {"share": share}
    if "force_area" in chosen_terms:
        chosen_terms["force_area"] = {"area": build_parameter("area"), "share": share}
    base_parameters = {name: build_parameter(name) for name in ("kappa", "tau_g", "phi") if name in values}
    return base.model_copy(update={"terms": chosen_terms, **base_parameters})


def fit_terms(base, terms, half):
    """Fit the logarithm of model over measured to one half. Return the values and the fitted facts."""
    facts, names = load_paper_facts(), list_free_parameters(terms)
    fitted_facts = [fact for fact in HALVES[half] if "n" in names or "T_peak" not in fact]

    def compute_residuals(x):
        predicted = simulate_outcomes(build_parameters(base, terms, dict(zip(names, x, strict=True))))
        return [np.log(facts[fact].ratio(predicted[fact])) for fact in fitted_facts]

    start, low, high = (np.array([FREE_PARAMETERS[name][k] for name in names]) for k in range(3))
    best = least_squares(
        compute_residuals, start, bounds=(low, high), x_scale=start, diff_step=1e-3, xtol=1e-7, ftol=1e-9
    )
    return dict(zip(names, best.x.tolist(), strict=True)), fitted_facts


def measure_gains():
    """Return values, ratios, and the error on facts outside the fit, by model and half."""
    base, facts = load_parameters("extended"), load_paper_facts()
    results = {}
    for model, terms in MODELS.items():
        for half in HALVES:
            values, fitted_facts = fit_terms(base, terms, half)
            predicted = simulate_outcomes(build_parameters(base, terms, values))
            ratios = {fact: facts[fact].ratio(predicted[fact]) for fact in JUDGED_FACTS}
            held_out = [fact for fact in JUDGED_FACTS if fact not in HALVES[half] and fact != "N_50um"]
            error = float(np.sqrt(np.mean([np.log(ratios[fact]) ** 2 for fact in held_out])))
            results[f"{model}, {half} half"] = {
                "values": values,
                "ratios": ratios,
                "fitted_facts": fitted_facts,
                "error": error,
            }
            print(model, half, values, f"{100 * error:.1f} %", file=sys.stderr)
    return results


def format_table(results):
    """Format the ratios by model as Markdown. Facts of the fit are bold."""
    lines = [
        "| model | fitted half | " + " | ".join(JUDGED_FACTS) + " | held-out error |",
        "| --- " * (len(JUDGED_FACTS) + 3) + "|",
    ]
    for name, row in results.items():
        model, half = name.removesuffix(" half").split(", ")
        cells = [
            f"**{row['ratios'][fact]:.2f}**" if fact in row["fitted_facts"] else f"{row['ratios'][fact]:.2f}"
            for fact in JUDGED_FACTS
        ]
        lines.append(f"| {model} | {half} | " + " | ".join(cells) + f" | {100 * row['error']:.0f} % |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(prog="scripts/calibrate-extended", description=__doc__)
    parser.add_argument("--json", action="store_true")
    results = measure_gains()
    print(json.dumps(results, indent=2) if parser.parse_args().json else format_table(results))


if __name__ == "__main__":
    main()
