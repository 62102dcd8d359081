"""Fit kappa, tau_g and phi to one fact each. The parameters epsilon, R and C keep the values of the paper."""

import argparse
import re
from pathlib import Path
from statistics import stdev

from scipy.optimize import brentq

from optodrive.device.config_file import locate_shipped
from optodrive.lab.validation.outcomes import FITTED_ON, OUTCOMES
from optodrive.physics.paper_facts import load_paper_facts
from optodrive.physics.parameters import Parameter, ParameterSet, load_parameters

BRACKETS = {"kappa": (1e-7, 1e-4), "tau_g": (2e-4, 5e-2), "phi": (1e-6, 1e-1)}
UNITS = {"kappa": "m/K", "tau_g": "s", "phi": "N/K"}
SCATTER = {
    "kappa": ("z_peak_w020", "z_peak_w075", "z_tp8_w040"),
    "tau_g": ("dpp_200Hz", "z_tp8_w040"),
    "phi": ("F_peak_w020", "F_peak_w055"),
}
"""Facts by parameter; sigma is the scatter of the values that each fact alone gives with the other parameters fixed."""

EXCLUDED_FACTS = {"tau_g": ("N_50um",)}
"""Facts that contradict those of SCATTER at every width of Table S3; their own width is not stated."""

CLAIMS = """\
kappa, tau_g and phi are each fitted to one fact; epsilon, R and C are the paper's. A displacement determines only the
product of kappa and the gas's half of the absorber's rise. Valid for single pulses of 8 to 50 ms and trains up to
200 Hz, but not for the blocked force at every width; phi is known to 15 %, tau_g to a quarter. The fit of tau_g assumes
that the ripple was measured at full power, which the paper does not state: at a tenth less, tau_g would be 2.6 ms.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=locate_shipped("parameters", "calibrated.toml"))
    out = parser.parse_args().out
    fitted = fit_parameters(load_parameters("paper_s1_literal"))
    single_fact_values = {
        name: {fact: solve_for_fact(fitted, name, fact) for fact in facts} for name, facts in SCATTER.items()
    }
    sigmas = {name: stdev(values.values()) for name, values in single_fact_values.items()}
    for name, fact in FITTED_ON.items():
        value = getattr(fitted, name).value
        print(f"{name:6} {value:.4g} ± {sigmas[name]:.2g} {UNITS[name]}, fitted on {fact}")
        for other, implied in single_fact_values[name].items():
            print(f"         {other:12} alone gives {implied:.4g}")
        for other in EXCLUDED_FACTS.get(name, ()):
            print(
                f"         {other:12} alone gives {solve_for_fact(fitted, name, other):.4g} (excluded: fits no width)"
            )
    out.write_text(format_toml(fitted, sigmas), encoding="utf-8")
    print(f"written {out}")


def fit_parameters(start: ParameterSet) -> ParameterSet:
    """Solve for each parameter in turn until convergence: kappa and tau_g affect each other's fact."""
    current = start
    while True:
        previous = current
        for name, fact in FITTED_ON.items():
            current = replace_value(current, name, solve_for_fact(current, name, fact))
        if all(abs(getattr(current, n).value / getattr(previous, n).value - 1) < 1e-9 for n in FITTED_ON):
            return current


def solve_for_fact(parameters: ParameterSet, name: str, fact: str) -> float:
    """Return the value of one parameter that reproduces one fact, with the others fixed."""
    low, high = BRACKETS[name]
    measured = load_paper_facts()[fact].value
    outcome = OUTCOMES[fact]
    return float(brentq(lambda v: outcome(replace_value(parameters, name, v)) / measured - 1.0, low, high, rtol=1e-12))


def replace_value(parameters: ParameterSet, name: str, value: float) -> ParameterSet:
    """Return the set with one parameter replaced."""
    parameter = Parameter(value=value, unit=UNITS[name], source=f"fitted on {FITTED_ON[name]}")
    return parameters.model_copy(update={name: parameter})


def format_toml(fitted: ParameterSet, sigmas: dict[str, float]) -> str:
    """Format the calibrated set as TOML. Parameters of the paper are copied from the file of the literal set."""
    own = locate_shipped("parameters", "paper_s1_literal.toml").read_text(encoding="utf-8")
    epsilon = re.search(r"\[epsilon\].*?(?=\n\[)", own, re.DOTALL).group()
    absorber = own[own.index("[R_width_product]") :]
    head = f'format = "optodrive-parameters"\nversion = 1\nname = "calibrated"\nclaims = """\n{CLAIMS}"""\n'
    return "\n".join(
        [head, epsilon, *(_format_block(fitted, name, sigmas[name]) for name in ("tau_g", "kappa", "phi")), absorber]
    )


def _format_block(fitted: ParameterSet, name: str, sigma: float) -> str:
    source = f"fitted on {FITTED_ON[name]}; sigma: scatter of what {', '.join(SCATTER[name])} ask for alone"
    value = getattr(fitted, name).value
    return f'[{name}]\nvalue = {value:.4g}\nunit = "{UNITS[name]}"\nsigma = {sigma:.2g}\nsource = "{source}"\n'


if __name__ == "__main__":
    main()
