"""`optodrive discover`: find the terms that a simulation of ordinary differential equations lacks."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.options import JsonOption
from optodrive.cli.output import print_answer, show_step
from optodrive.cli.signals import end_as_interrupted
from optodrive.core.extras import import_extra

if TYPE_CHECKING:
    from optodrive.lab.discovery import Discovery

ModelArgument = Annotated[Path, typer.Argument(metavar="MODEL.py", help="Python file that defines model.")]
RecordsArgument = Annotated[
    list[Path], typer.Argument(metavar="RECORD.csv", help="Columns t_s, and the inputs and outputs by name.")
]


def discover(model: ModelArgument, records: RecordsArgument, json: JsonOption = False) -> None:
    """Find the terms that a simulation lacks, in measured records of any system."""
    import_extra("scipy")
    from optodrive.lab.discovery import discover as search
    from optodrive.lab.discovery.model import load_model, read_record

    simulation = load_model(model)
    train = [read_record(path, simulation) for path in records]
    with end_as_interrupted(), show_step("reading") as on_progress:
        answer = search(simulation, train, progress=lambda stage, fraction: on_progress(stage))
    print_answer(build_document(answer), build_lines(answer), json)


def build_document(answer: "Discovery") -> dict[str, object]:
    """Return the answer as JSON."""
    from optodrive.lab.inference.sentences import build_term_document

    return {
        "verdict": answer.claim.verdict,
        "findings": [
            {
                "where": each.term.chosen.where,
                "depends_on": list(each.term.chosen.depends_on),
                "formula": each.term.chosen.formula,
                "kind": each.term.chosen.kind,
                **build_term_document(each.term),
                "tested": {name: list(ends) for name, ends in each.tested.items()},
                "curve": {name: getattr(each.curve, name).tolist() for name in ("x", "y", "low", "high")},
            }
            for each in answer.findings
        ],
        "judged_by": answer.judged_by,
        "base_rmse": answer.base_rmse,
        "extended_rmse": answer.extended_rmse,
        "noise": answer.noise,
        "parameters": answer.parameters,
        "base_parameters": answer.base_parameters,
    }


def build_lines(answer: "Discovery") -> list[str]:
    """Return the answer as text."""
    from optodrive.lab.inference.sentences import describe_no_term, describe_term

    if not answer.findings:
        return describe_no_term(answer.claim, answer.base_rmse, answer.noise, answer.judged_by)
    lines = []
    for each in answer.findings:
        ranges = " and ".join(f"{name} from {low:.4g} to {high:.4g}" for name, (low, high) in each.tested.items())
        lines += [*describe_term(each.term), f"  not tested outside of {ranges}"]
    lines.append(
        f"held-out error {answer.base_rmse:.4g} before, {answer.extended_rmse:.4g} after, in {answer.judged_by}"
    )
    lines.append("parameters " + ", ".join(f"{name} {value:.6g}" for name, value in answer.parameters.items()))
    return lines
