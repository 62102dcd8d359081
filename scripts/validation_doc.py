"""Write docs/explanation/validation.md, the rows of `optodrive validate` with their discussion, and
docs/reference/paper-facts.md, what each row is.
"""

import argparse
from pathlib import Path

from optodrive.cli.validation_table import HEADINGS, build_validation_rows, format_cells
from optodrive.lab.validation import narrative
from optodrive.lab.validation.facts import EXCLUDED
from optodrive.lab.validation.outcomes import NOT_MODELLED
from optodrive.lab.validation.study import run_study
from optodrive.physics.paper_facts import load_paper_facts
from optodrive.physics.parameters import load_parameters

INTRODUCTION = """\
# Validation

This page compares the models with the paper. `scripts/validation-doc` generates it; `optodrive validate` prints the
same rows, and those of the inputs. [The paper's facts](../reference/paper-facts.md) says what each row is.

`literal` is the set `paper_s1_literal`, Text S1 without any fit. `calibrated` drives the displays; it is
fitted by `scripts/calibrate-parameters` to three facts, one per parameter: κ to `z_peak_w020`, τ_g to
`dpp_200Hz`, φ to `F_peak_w020`. `eta_stroke` follows from two of them and counts as fitted. All other rows are
predictions. `extended` is the model with terms, fitted by `scripts/calibrate-extended` to the same facts and the
temperature of the same pixel ([extended model](extended-model.md)).

- Full power is 2.45 W, the reading of the bolometer, also where a figure says 2.5 W.
- The ratio is model over measured, of temperatures by their rises above 20 °C; an upper bound has none.
- No power is given for `dpp_200Hz` and `z_tp8_w040`: both are evaluated at full power. With 10 % less for the ripple
  τ_g would be 2.6 ms instead of 3.0.
- `N_50um` alone would require τ_g = 17 ms. It contradicts the other displacements at every width, so neither the fit
  nor the uncertainty of τ_g includes it.
- `F_linear_in_P` and `z_repeat_w040` hold by construction: the model is linear and has no memory beyond 5 s.
- The paper fitted R and C to the first 30 ms of the temperatures that are predicted here at 50 ms.
- The extended set derives the gas's rise from its force, by the gas law on the whole aperture, as the paper did.
- That the gas settles at half the absorber's rise is an assumption of Text S1; displacements determine only its product
  with κ.
"""

LITERAL_SECTION = """\
## Results of the literal set

Its gas lags by 64 ms. This halves the displacement of a 50 ms pulse and reduces that of an 8 ms pulse to a quarter and
the 200 Hz ripple to a twentieth. Its κ, 3.9 µm/K, is within 3 % of the fitted one by coincidence: its formula has
3/1280 where a clamped plate has 3/16, and uses the pressure at constant volume under a membrane that rises by a
millimetre. Its φ is ten times the fitted one.

The two laws of Fig. 3D belong to opposite limits. In a linear pixel without lag the ripple follows 1 − exp(−t_g/τ) for
pulses much longer than τ, and the mean follows τ/t_g for pulses much shorter; at t_p = t_g = τ it gives 0.73 and 0.79.
"""

DIAGNOSIS_SECTION = """\
## Results of `optodrive validate --diagnose`

The command treats the twelve measured outcomes as a recording and the literal set as the model. It weighs sets of
causes, and repeats selection and fit without each group of facts to predict that group. A cause is named as in a
[diagnosis](diagnosis.md). There are no repeats, so the noise is an assumption; what one fact shows, nothing tests. It
begins:
"""

DISCUSSION_SECTION = """\
- The lag is certain: displacements and vibration each predict the other, with causes found without them.
- So is the error of the force, but not its reason: a smaller area and a compliant load cell are nearly the same line
  through two numbers. Without any force the extended model is worse than the literal one, because its gas is correctly
  warmer: two errors had compensated each other.
- No fit can tell that the membrane is not a plate and the gas not at constant volume. The two errors cancel in
  Text S1's displacement per kelvin. Volume and force reveal them by arithmetic.
- A dead time of 2.3 ms makes 50 µm at 217 pixels per second agree with everything else, and 400 µm at 26.5 as well. It
  depends on the first number. The paper mentions pulse times only, so the dead
  time is the meaning of that number, not a finding.
- χ² is below the degrees of freedom: errors of 11 % are wide for these facts. With 2 to 15 % between samples
  instead of 10 % the same causes are named; with 25 % the dead time is not.
- Facts of one paper share samples and instruments. The gain shows that few causes explain many numbers, not how another
  display behaves.
"""

FACTS_INTRODUCTION = """\
# The paper's facts

The paper is M. Linnander et al., *Tactile Displays Driven by Projected Light* (arXiv:2410.05494).
[Validation](../explanation/validation.md) compares the models with its facts; `scripts/validation-doc` generates both
pages.

## Rows
"""

JSON_KEYS = """\
## `optodrive validate --diagnose --json`

One object, SI units, temperatures as rises in K, with the members that the text has: `parameter_set`, `verdict`, `sets`
(the causes named), `reasons`, `probabilities`, `facts` (each with the ratios of both models and `error_sigma`),
`excluded`, `unexplained` (facts that deviate by more than two standard errors), `chi2`, `factor`, `aicc_per_cause`,
`aicc_indistinguishable`, `causes` (each with value, 95 % interval, `evidence`, `alternatives`, `deciding_measurement`),
`candidates` (all other causes), `contradictions`, and `gain` by held-out group and fact.
"""


def build_page():
    """Return the page."""
    rows = build_validation_rows()
    parts = [
        INTRODUCTION,
        "## Outcomes\n",
        format_table(row for row in rows if row.role != "input"),
        "## Deviations of the calibrated set above 15 %\n",
        format_bullets((row.fact.id, row.remark) for row in rows if row.remark),
        LITERAL_SECTION,
        build_diagnosis_section(),
    ]
    return "\n".join(parts)


def build_facts_page():
    """Return the page of the facts: what each is, why some are no measurement, and why no model predicts the others."""
    parts = [
        FACTS_INTRODUCTION,
        format_bullets(
            (row.fact.id, describe_fact(row.fact)) for row in build_validation_rows() if row.role != "input"
        ),
        "## Facts that a diagnosis excludes\n",
        format_bullets(EXCLUDED.items()),
        "## Facts outside the models\n",
        format_bullets(NOT_MODELLED.items()),
        JSON_KEYS,
    ]
    return "\n".join(parts)


def build_diagnosis_section():
    """Return the diagnosis of the paper's facts, with its table."""
    study_result = run_study(load_paper_facts(), load_parameters("paper_s1_literal"))
    lines = [narrative.HEADINGS, ("---",) * len(narrative.HEADINGS), *narrative.build_rows(study_result)]
    parts = [
        DIAGNOSIS_SECTION,
        format_quote(keep_findings(narrative.describe_findings(study_result))),
        "".join("| " + " | ".join(line) + " |\n" for line in lines),
        "".join(f"{line}\n" for line in narrative.describe_predictions(study_result) if "error factor" in line),
        DISCUSSION_SECTION,
    ]
    return "\n".join(parts)


def keep_findings(lines):
    """Return the lines on the best sets, without those on single causes."""
    causes = next((k for k, line in enumerate(lines) if line.startswith("Causes of")), len(lines))
    return [*lines[:causes], *(line for line in lines if line.startswith("With these")), "…"]


def format_quote(lines):
    """Return lines as a quotation."""
    return "".join(f"> {line}".rstrip() + "\n" for line in lines)


def format_table(rows):
    """Return a table with its headings."""
    lines = [HEADINGS, ("---", "--:", "--:", "--:", "--:", "--:", "---", "--:", "--:", "---"), *map(format_cells, rows)]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def format_bullets(items):
    """Return one bullet per remark, with all names that it has."""
    names = {}
    for name, text in items:
        names.setdefault(text, []).append(f"`{name}`")
    return "".join(f"- {', '.join(named)}: {text}\n" for text, named in names.items())


def describe_fact(fact):
    """Return quantity, conditions and place of a fact."""
    conditions = f" ({fact.conditions})" if fact.conditions else ""
    return f"{fact.quantity}{conditions}. {fact.where}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the documentation")
    folder = parser.parse_args().out
    for name, build in (("explanation/validation.md", build_page), ("reference/paper-facts.md", build_facts_page)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(build(), encoding="utf-8")
