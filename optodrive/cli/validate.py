"""`optodrive validate`: compare the models with the facts of the paper, or diagnose the model of Text S1 by them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.options import JsonOption, check_model_path
from optodrive.cli.output import announce_compilation, print_json, show_step
from optodrive.core.errors import InputError
from optodrive.core.extras import import_extra

if TYPE_CHECKING:
    from optodrive.lab.validation.study import StudyResult


def validate(
    json: JsonOption = False,
    diagnose: Annotated[
        bool,
        typer.Option(
            "--diagnose",
            help="Name the errors of Text S1 in the paper's measurements, and the gain from correcting them.",
        ),
    ] = False,
    model: Annotated[
        Path | None, typer.Option("--model", metavar="model.toml", help="Compare this parameter set too.")
    ] = None,
) -> None:
    """Compare the models with every fact of the paper that they predict."""
    if diagnose and model is not None:
        raise InputError("--model", str(model), "--diagnose or --model, not both: --diagnose starts from Text S1")
    if diagnose:
        diagnose_paper_facts(json)
        return
    from optodrive.cli.validation_table import print_validation

    print_validation(json, None if model is None else check_model_path(model))


LITERAL_SET = "paper_s1_literal"
MIN_TABLE_WIDTH = 110
"""Narrower terminals wrap lines instead of truncating digits, in characters."""


def diagnose_paper_facts(json: bool = False) -> None:
    """Print the narrative, or one JSON object."""
    import_extra("scipy")
    from optodrive.lab.validation.narrative import build_study_answer
    from optodrive.lab.validation.study import run_study
    from optodrive.physics.paper_facts import load_paper_facts
    from optodrive.physics.parameters import load_parameters

    announce_compilation()
    with show_step("reading the facts") as on_progress:
        study_result = run_study(load_paper_facts(), load_parameters(LITERAL_SET), on_progress)
    if json:
        print_json(build_study_answer(study_result))
    else:
        _print_narrative(study_result)


def _print_narrative(study_result: "StudyResult") -> None:
    from rich.console import Console
    from rich.table import Table

    from optodrive.lab.validation.narrative import (
        HEADINGS,
        build_rows,
        describe_assumptions,
        describe_findings,
        describe_predictions,
    )

    console = Console(width=max(Console().width, MIN_TABLE_WIDTH))

    def print_lines(lines: list[str]) -> None:
        for line in lines:
            console.print(line, highlight=False, markup=False)

    print_lines(describe_findings(study_result))
    table = Table(title="Predictions of held-out facts: causes selected and fitted without them, model over measured")
    for heading in HEADINGS:
        table.add_column(heading)
    for row in build_rows(study_result):
        table.add_row(*row)
    print_lines([""])
    console.print(table)
    print_lines([*describe_predictions(study_result), "", *describe_assumptions(study_result)])
