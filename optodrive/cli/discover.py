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
    from optodrive.lab.discovery.input_files import load_model, read_record

    simulation = load_model(model)
    train = [read_record(path, simulation) for path in records]
    with end_as_interrupted(), show_step("reading") as on_progress:
        answer = search(simulation, train, progress=lambda stage, fraction: on_progress(stage))
    print_answer(build_document(answer), build_lines(answer), json)


def build_document(answer: "Discovery") -> dict[str, object]:
    """Return the answer as JSON."""
    return {
        "findings": [
            {
                "where": each.where,
                "depends_on": list(each.depends_on),
                "formula": each.formula,
                "kind": each.kind,
                "gain": each.gain,
                "probability": each.probability,
                "curve": {name: getattr(each.curve, name).tolist() for name in ("x", "y", "low", "high")},
            }
            for each in answer.findings
        ],
        "base_rmse": answer.base_rmse,
        "extended_rmse": answer.extended_rmse,
        "parameters": answer.parameters,
        "base_parameters": answer.base_parameters,
    }


def build_lines(answer: "Discovery") -> list[str]:
    """Return the answer as text."""
    if not answer.findings:
        return [f"no missing term found; held-out error of the fitted simulation {answer.base_rmse:.4g}"]
    lines = []
    for each in answer.findings:
        lines.append(f"{each.where} lacks {each.formula}")
        lines.append(
            f"  {each.kind} in {' and '.join(each.depends_on)}; removes {100 * each.gain:.0f} % of the avoidable "
            f"held-out error; probability {each.probability:.4f}"
        )
    lines.append(f"held-out error {answer.base_rmse:.4g} before, {answer.extended_rmse:.4g} after")
    lines.append("parameters " + ", ".join(f"{name} {value:.6g}" for name, value in answer.parameters.items()))
    return lines
