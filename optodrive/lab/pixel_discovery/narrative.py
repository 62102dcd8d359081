"""A discovery in a pixel as text, as JSON and as a section of the report."""

from collections.abc import Sequence
from typing import Any

from optodrive.core.document import Figure, Section
from optodrive.core.quantity import format_quantity
from optodrive.core.svg_plot import Axis, Series, draw_plot
from optodrive.lab.discovery import Curve
from optodrive.lab.discovery.forms import NAMELESS
from optodrive.lab.inference.sentences import build_term_document, describe_no_term, describe_term
from optodrive.lab.pixel_discovery.findings import NODES, UNITS, PixelDiscovery, PixelFinding
from optodrive.lab.pixel_discovery.planned_terms import PlannedTerms

PLOT_HEIGHT = 200
VARIABLES = {
    "absorber": ("rise of the absorber", "K"),
    "gas": ("rise of the gas", "K"),
    "memory": ("rise of a part that follows the absorber", "K"),
    "heating": ("rate of the absorber", "K/s"),
    "drive": ("half the absorber's rise less the gas's", "K"),
    "light": ("absorbed light", "W"),
    "after": ("absorbed light of the pulse before", "W"),
    "since_opening": ("time since the gate opened", "s"),
    "since_closing": ("time since the gate closed", "s"),
    "t": ("time in the run", "s"),
}
"""Variables of the pixel with their unit."""
PLACES = {
    "dabsorber/dt": "the rate of the absorber's temperature",
    "dgas/dt": "the rate of the gas's temperature",
    "temperature": "the measured temperature",
    "displacement": "the measured displacement",
    "force": "the measured force",
}


def build_lines(discovery: PixelDiscovery) -> list[str]:
    """Return the lines of text."""
    if not discovery.judged_by:
        return ["No missing term was sought: too few experiments light a measured pixel alone."]
    judged = f"on {discovery.judged_by}"
    if not discovery.findings:
        lines = describe_no_term(discovery.claim, discovery.error_before, 1.0, discovery.judged_by)
        return [f"A term that nobody wrote down: {lines[0]} (1: the noise).", *lines[1:]]
    lines = [line for finding in discovery.findings for line in _describe(finding)]
    before, after = discovery.error_before, discovery.error_after
    return [
        *lines,
        f"The error is {before:.2f} times the noise without it, {after:.2f} times with it; judged {judged}.",
    ]


def build_planning_lines(planned: PlannedTerms, model: str) -> list[str]:
    """Return lines that state whether heights are planned with the findings.

    model: path of the parameter file
    """
    lines = [f"Heights cannot be planned with it: {reason}." for reason in planned.refused]
    if planned.terms:
        lines.append(f"Heights are planned with it: optodrive plan frames.json --model {model}")
    elif not planned.refused:
        lines.append(f"It changes a reading and no height; {model} is the pixel without it.")
    return lines


def _describe(finding: PixelFinding) -> list[str]:
    form, node = finding.term.chosen, NODES[finding.node]
    if finding.curve is None:
        head = f"A term that nobody wrote down: {node} changes at random, other in every repeat."
        return [head, f"  {form.formula}", *describe_term(finding.term)[1:]]
    on = " times ".join(VARIABLES[name][0] for name in form.depends_on)
    kind = finding.kind if finding.term.is_sure or form.kind in NAMELESS else f"perhaps {finding.kind}"
    return [
        f"A term that nobody wrote down: {node} lacks one that depends on {on} ({kind}).",
        f"  {PLACES[form.where]}, {UNITS[form.where]}: {form.formula}",
        *describe_term(finding.term)[1:],
    ]


def build_document(discovery: PixelDiscovery) -> dict[str, Any]:
    """Return the discovery as JSON values."""
    return {
        "findings": [
            {
                "node": each.node,
                "where": each.term.chosen.where,
                "unit": UNITS[each.term.chosen.where],
                "depends_on": [{"name": name, "unit": VARIABLES[name][1]} for name in each.term.chosen.depends_on],
                "kind": each.kind,
                "formula": each.term.chosen.formula,
                **build_term_document(each.term),
                "curve": None
                if each.curve is None
                else {name: getattr(each.curve, name).tolist() for name in ("x", "y", "low", "high")},
            }
            for each in discovery.findings
        ],
        "verdict": discovery.claim.verdict,
        "error_before": discovery.error_before,
        "error_after": discovery.error_after,
        "judged_by": discovery.judged_by,
        "parameters": discovery.parameters,
        "elapsed_s": discovery.elapsed_s,
    }


def build_section(discovery: PixelDiscovery, lines: Sequence[str]) -> Section:
    """Return the section of the report: lines of text, and the curve of each term with its 95 % band."""
    curves = [_draw_curve(each, each.curve) for each in discovery.findings if each.curve is not None]
    return Section("Terms that nobody wrote down", [*lines, *([curves] if curves else [])])


def _draw_curve(finding: PixelFinding, curve: Curve) -> Figure:
    form = finding.term.chosen
    quantity, unit = VARIABLES[form.depends_on[0]]
    factor = VARIABLES[form.depends_on[1]] if len(form.depends_on) > 1 else None
    y_axis = Axis(form.where if factor is None else f"{form.where} per {factor[1]}", UNITS[form.where])
    series = [Series(curve.y, "extended"), Series(curve.low, "nominal"), Series(curve.high, "nominal")]
    plot = draw_plot(f"{form.where} against {quantity}", curve.x, Axis(quantity, unit), y_axis, series, PLOT_HEIGHT)
    span = f"{format_quantity(float(curve.x[0]), unit)} to {format_quantity(float(curve.x[-1]), unit)}"
    caption = f"{form.formula}; over the data, {span}, and not tested outside. Dashed: 95 % band."
    return Figure(plot, caption)
