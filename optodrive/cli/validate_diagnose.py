"""`optodrive validate --diagnose`: diagnose the model of Text S1 with the facts of the paper as data."""

from typing import TYPE_CHECKING

from optodrive.cli.output import announce_compilation, print_json, show_step
from optodrive.core.extras import import_extra

if TYPE_CHECKING:
    from optodrive.lab.validation.study import StudyResult

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
