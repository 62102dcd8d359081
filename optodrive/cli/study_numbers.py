"""Numbers of a study: its power beforehand, the summary of a run, and the report of a dataset."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.options import ConfigOption, JsonOption
from optodrive.cli.output import announce_compilation, print_answer, show_progress
from optodrive.core.errors import InputError

if TYPE_CHECKING:
    from optodrive.study.study_file import Study

PARTICIPANTS_MAX = 1000
SEEDS_MAX, SIMULATED_TRIALS = 100_000, 150_000
POWER_SOUGHT = 0.8
"""Power that is customarily sought."""
STUDY_HELP = (
    "A study file, or a shipped one: apparent-motion, detection, equal-intensity, equalisation, experiment-1 to "
    "experiment-6, frequency-discrimination, gap-detection, height-threshold, pattern-identification, reading-speed, "
    "roughness, temporal-order, two-point."
)


def power(
    source: Annotated[str, typer.Argument(metavar="STUDY", help=STUDY_HELP)],
    participants: Annotated[
        str, typer.Option("--participants", metavar="N|N..M", help="Numbers of participants of the study.")
    ] = "4..40",
    compare: Annotated[
        str | None,
        typer.Option("--compare", metavar="FACTOR", help="Compare the last and the first value of a factor."),
    ] = None,
    reference: Annotated[
        float | None,
        typer.Option(
            "--reference",
            metavar="VALUE",
            help="What the interval is to exclude: a share (the chance level by default), a threshold, a difference.",
        ),
    ] = None,
    spread: Annotated[
        float,
        typer.Option(
            "--spread", metavar="SD", help="How participants differ: standard deviation of the logarithm of acuity."
        ),
    ] = 0.0,
    seeds: Annotated[
        int | None,
        typer.Option(
            "--seeds",
            metavar="K",
            help="Number of simulated participants: by default 500 to 5000, 300 with a procedure.",
        ),
    ] = None,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Estimate from simulated participants how often a study with a number of participants shows its effect.

    The power is the share of studies whose 95 % interval excludes the reference.
    """
    from optodrive.device.config_file import load_config
    from optodrive.planning.display_model import DisplayModel
    from optodrive.study.power import compute_powers, measure_effect, simulate_sessions
    from optodrive.study.study_file import load_study, name_lines
    from optodrive.study.trial_stimulus import check_stimuli

    design, numbers = load_study(source), _parse_numbers(participants)
    if design.matching is not None:
        raise InputError("study", source, "a study with correct answers, a procedure or factors, not a matching")
    per_person = design.trial_count * design.sessions
    usual = 300 if design.procedure is not None else min(max(SIMULATED_TRIALS // per_person, 500), 5000)
    count = usual if seeds is None else seeds
    if not 10 <= count <= SEEDS_MAX:
        raise InputError("--seeds", count, f"10 to {SEEDS_MAX}")
    if not 0.0 <= spread <= 3.0:
        raise InputError("--spread", spread, "0 to 3")
    display_config = load_config(config)
    with name_lines(source):
        check_stimuli(design, display_config)
    measure_effect(design, [], compare, reference, spread)  # refuses what the design has not, before it simulates
    announce_compilation()
    with show_progress("simulating") as on_progress:
        people = simulate_sessions(design, DisplayModel.from_config(display_config), count, spread, on_progress)
    effect = measure_effect(design, people, compare, reference, spread)
    powers = list(compute_powers(effect, numbers, design.seed))
    enough = next((one.participants for one in powers if one.power >= POWER_SOUGHT), None)
    report: dict[str, Any] = {
        "study": design.name,
        "effect": effect.name,
        "reference": effect.reference,
        "mean": effect.mean,
        "test": effect.test,
        "simulated_participants": count,
        "simulated_participants_with_a_value": effect.known,
        "spread": spread,
        "enough_participants": enough,
        "powers": [one._asdict() for one in powers],
    }
    print_answer(report, _format_powers(report), json)


def _parse_numbers(text: str) -> range:
    """Return the numbers of a range such as 4..40. Raise InputError."""
    low, _, high = text.partition("..")
    numbers = [int(each) for each in (low, high or low) if each.isascii() and each.isdigit()]
    if len(numbers) != 2 or not 2 <= numbers[0] <= numbers[1] <= PARTICIPANTS_MAX:
        raise InputError("--participants", text, f"a number from 2 to {PARTICIPANTS_MAX}, or two such as 4..40")
    return range(numbers[0], numbers[1] + 1)


def _format_powers(report: dict[str, Any]) -> Iterator[str]:
    yield f"study            {report['study']}"
    yield f"effect           {report['effect']}: {report['mean']:.4g}, reference {report['reference']:.4g}"
    yield f"test             {report['test']}"
    alike = "all alike; --spread states how they differ" if report["spread"] == 0.0 else f"spread {report['spread']:g}"
    yield f"simulated        {report['simulated_participants']} participants, {alike}"
    if (known := report["simulated_participants_with_a_value"]) < report["simulated_participants"]:
        yield f"known            of {known} of them; those whose threshold the levels do not determine do not enter"
    for one in report["powers"]:
        shown = f"power {one['power']:.3f} (95 % interval {one['low']:.3f} to {one['high']:.3f})"
        yield f"{one['participants']:<17}{shown}, effect {one['effect_low']:.4g} to {one['effect_high']:.4g}"
    enough = report["enough_participants"]
    yield f"enough           {'none of these' if enough is None else enough} for a power of {POWER_SOUGHT:g}"


def report(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Dataset (BIDS) that a study has written.")],
    json: JsonOption = False,
) -> None:
    """Judge the trials of a dataset by its tables alone. Write a page, a table and the numbers of each study to it.

    They are FOLDER/derivatives/task-NAME_report.html, _trials.tsv and _report.json.
    """
    from json import dumps

    from optodrive.core.files import create_folder, write_text
    from optodrive.core.provenance import Provenance
    from optodrive.study.report import StudyResults
    from optodrive.study.trial_table import read_tables

    provenance = Provenance.capture(["study", "report", str(folder)], [str(folder)])
    documents, lines = {}, list[str]()
    for table in read_tables(folder):
        results = StudyResults(table)
        stem = folder / "derivatives" / f"task-{table.task}"
        create_folder(stem.parent)
        documents[table.task] = results.to_document()
        write_text(stem.with_name(f"{stem.name}_report.html"), results.to_html(provenance))
        write_text(stem.with_name(f"{stem.name}_trials.tsv"), table.format())
        numbers = documents[table.task] | {"provenance": provenance.to_dict()}
        write_text(stem.with_name(f"{stem.name}_report.json"), dumps(numbers, indent=2, ensure_ascii=False) + "\n")
        lines += [*results.list_lines(), f"written: {stem}_report.html, _report.json, _trials.tsv"]
    print_answer(documents, lines, json)


def build_summary(design: "Study", sessions: dict[str, list[dict[str, Any]]], out: Path) -> dict[str, Any]:
    """Return the numbers of a run. sessions: records of trials by participant and session."""
    from optodrive.study.results import Accuracy, count_correct, fit_magnitudes, list_thresholds
    from optodrive.study.trial_list import find_exclusion, find_session_exclusion

    published = design.published
    main = {name: [one for one in records if one["phase"] == "main"] for name, records in sessions.items()}
    sessions = {
        name: [one for one in main[name] if not excluded and find_exclusion(design, one) is None]
        for name, records in sessions.items()
        for excluded in [find_session_exclusion(design, records)]
    }
    shown, records = [[record for session in each.values() for record in session] for each in (main, sessions)]
    report: dict[str, Any] = {
        "study": design.name,
        "participants": {name: len(session) for name, session in main.items()},
        "trials": len(shown),
        "excluded": len(shown) - len(records),
        "stimuli_per_trial": sum(len(record["presentations"]) for record in shown) / len(shown),
        "repeated": sum(record["attempt"] > 1 for record in shown),
        "chance_level": design.response.chance_level,
    }
    counted = count_correct(records)
    if design.response.rules and counted.trials:
        report |= {"correct": counted.correct, "judged": counted.trials, "accuracy": counted.share}
    elif design.response.kind == "magnitude" and len(design.factors) == 1 and all(sessions.values()):
        report["line"] = fit_magnitudes(design, list(sessions.values()))._asdict()
    if design.threshold_of is not None:
        report["threshold_of"] = design.threshold_of
        report["thresholds"] = list_thresholds(design, sessions)
    if published is not None:
        report["published"] = published.model_dump(mode="json") | {"trials": published.trials}
        if published.correct is not None:
            report["published"]["interval"] = list(Accuracy(published.correct, published.trials).interval)
    return report | {"written": str(out)}


def format_summary(report: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of a run's numbers."""
    from optodrive.study.threshold import ThresholdEstimate

    yield f"study            {report['study']}"
    participants = {name.partition("_")[0] for name in report["participants"]}
    yield f"participants     {len(participants)}, {report['trials']} trials in all"
    if report["repeated"]:
        yield f"repeated         {report['repeated']} trials whose first attempt was interrupted or spoiled"
    if report["excluded"]:
        yield f"excluded         {report['excluded']} trials by the rules of the study"
    if "accuracy" in report:
        yield (
            f"correct          {report['correct']} of {report['judged']}, {100 * report['accuracy']:.1f} % "
            f"(by chance {100 * report['chance_level']:.1f} %)"
        )
    if "line" in report:
        line = report["line"]
        means, values = line["r_squared"], line["participants_r_squared"]
        yield f"line             r² {means:.3f} of the means, {values:.2f} of all values"
    for name, found in report.get("thresholds", {}).items():
        if "threshold" not in found:
            equality = f"{report['threshold_of']} {found['equality']:.3g}"
            yield f"equality         {name}: {equality} ({found['reversals']} reversals)"
            continue
        estimate = ThresholdEstimate(**found)
        yield f"threshold        {name}: {report['threshold_of']} {estimate}"
        yield from (f"doubtful         {name}: {flag}: {flag.explanation}" for flag in estimate.flags)
    for name, found in report.get("sensitivity", {}).items():
        yield (
            f"sensitivity      {name}: {found['low']:.2f} to {found['high']:.2f}, "
            f"uncertainty {100 * found['uncertainty']:.1f} %, {found['written']}"
        )
        if "residual_variation" in found:
            before, after = found["variation"], found["residual_variation"]
            yield f"variation        {name}: felt {100 * before:.1f} % over the display, {100 * after:.1f} % equalised"
    yield from _format_published(report.get("published"))
    yield f"written          {report['written']}"


def _format_published(published: dict[str, Any] | None) -> Iterator[str]:
    if published is None:
        return
    counts = f"{published['participants']} participants, {published['trials']} trials"
    if published["correct"] is not None:
        low, high = published["interval"]
        share = published["correct"] / published["trials"]
        yield (
            f"published        {counts}, {published['correct']} correct: {100 * share:.1f} % "
            f"(95 % interval {100 * low:.1f} to {100 * high:.1f} %), {published['source']}"
        )
    elif published["r_squared"] is not None:
        yield f"published        {counts}, r² {published['r_squared']:.2f}, {published['source']}"
    for contradiction in published["contradictions"]:
        yield f"contradiction    {contradiction}"
