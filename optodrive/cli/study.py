"""`optodrive study run | power | report`: plan, run and judge a study with people or simulated participants.

`optodrive study STUDY` is short for `optodrive study run STUDY`.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.options import ConfigOption, HoldOption, JsonOption, UrlOption
from optodrive.cli.output import announce_compilation, print_answer, show_progress
from optodrive.core.daemon_url import DEFAULT_URL
from optodrive.core.errors import MISSING, InputError, NotReadyError, Unquoted

if TYPE_CHECKING:
    from optodrive.core.types.arrays import FloatArray
    from optodrive.device.config import Config, PixelLayout
    from optodrive.study.page_messages import PageAddress
    from optodrive.study.page_respondent import PageRespondent
    from optodrive.study.presenter import Presenter
    from optodrive.study.session import Respondent
    from optodrive.study.study_file import Study
    from optodrive.study.study_sections import MatchingSection
    from optodrive.study.trial_log import TrialLog

PARTICIPANTS_MAX = 1000
SEEDS_MAX, SIMULATED_TRIALS = 100_000, 150_000
POWER_SOUGHT = 0.8
"""Power that is customarily sought."""
STUDY_HELP = (
    "A study file, or a shipped one: apparent-motion, detection, equal-intensity, equalisation, experiment-1 to "
    "experiment-6, frequency-discrimination, gap-detection, height-threshold, pattern-identification, reading-speed, "
    "roughness, temporal-order, two-point."
)

GROUP = typer.Typer(
    help="Run a study (`study STUDY`, or `study run STUDY`), and judge its trials.", no_args_is_help=True
)


@GROUP.command()
def run(
    source: Annotated[str, typer.Argument(metavar="STUDY", help=STUDY_HELP)],
    out: Annotated[
        Path, typer.Option("--out", metavar="FOLDER", help="Dataset (BIDS); a session begun in it goes on.")
    ],
    participant: Annotated[
        str | None,
        typer.Option(
            "--participant",
            metavar="ID",
            help="A person's code: answers at this terminal, on the daemon's armed display.",
        ),
    ] = None,
    session: Annotated[
        int | None,
        typer.Option("--session", metavar="N", help="Number of the person's session, in a study of several."),
    ] = None,
    participants: Annotated[
        int,
        typer.Option("--participants", metavar="N", help="Number of simulated participants, without --participant."),
    ] = 1,
    lsl: Annotated[
        bool,
        typer.Option("--lsl", help="Publish pulses and trials to the Lab Streaming Layer, once a recorder reads them."),
    ] = False,
    page: Annotated[
        str | None,
        typer.Option(
            "--page",
            metavar="[HOST:]PORT",
            help="The person answers on a page in a browser, with an operator's page beside it. PORT 0: any free one.",
        ),
    ] = None,
    url: UrlOption = DEFAULT_URL,
    hold: HoldOption = False,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Run a study and write its dataset. Without --participant, participant and display are simulated, in virtual time.

    Every trial is on the disk before the next begins: the same command after an interruption goes on where it ended.
    """
    from optodrive.core.files import check_output
    from optodrive.study.dataset import check_new_participant, check_participant, read_participants, write_dataset
    from optodrive.study.study_file import SIMULATED_PREFIX, load_study
    from optodrive.study.trial_list import list_trials

    design = load_study(source)
    check_output("--out", out, folder=True, may_exist=True)
    if not 1 <= participants <= PARTICIPANTS_MAX:
        raise InputError("--participants", participants, f"1 to {PARTICIPANTS_MAX}")
    read_participants(out)  # refuses a damaged table before anybody takes part
    if participant is None:
        if page is not None:
            raise InputError("--page", page, "--participant: a simulated participant needs no page")
        if lsl:
            raise InputError("--lsl", True, "--participant: a simulated board has no time of this computer")
        if hold:
            raise InputError("--hold", True, "--participant: a simulated participant arms no board")
        if session is not None:
            raise InputError("--session", session, "--participant: a simulated participant takes part in all sessions")
    else:
        if participants != 1:
            raise InputError("--participants", participants, "none beside --participant, which is one person")
        if config is not None:
            raise InputError("--config", config, "none beside --participant: the daemon has its own")
        check_participant("--participant", participant)
        check_new_participant("--participant", out, participant)
        if participant.startswith(SIMULATED_PREFIX):
            raise InputError("--participant", participant, f"a code that does not begin with {SIMULATED_PREFIX!r}")
        if not (session is None if design.sessions == 1 else session is not None and 1 <= session <= design.sessions):
            expected = "none: the study has one session" if design.sessions == 1 else f"1 to {design.sessions}"
            raise InputError("--session", MISSING if session is None else session, expected)
        list_trials(design, participant, session or 1)  # refuses a code without a number beside a Latin square
    display_config = _load_display_config(design, participant, url, config)
    try:
        if participant is None:
            sessions = _simulate(design, out, participants, display_config)
        else:
            person = participant, session or 1
            sessions = {
                _name_session(design, *person): _run_person(design, out, *person, url, hold, lsl, page, display_config)
            }
    except BaseException:  # a session that has not ended has tables, too
        with suppress(InputError):
            if (out / "sourcedata").is_dir():
                write_dataset(out)
        raise
    write_dataset(out)
    report = _build_report(design, sessions, out)
    if design.matching is not None and display_config is not None:
        report["sensitivity"] = _write_sensitivity(design, design.matching, sessions, out, display_config)
    print_answer(report, _format_report(report), json)


@GROUP.command()
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
    from optodrive.study.study_file import load_study
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


@GROUP.command()
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


def _load_display_config(design: "Study", participant: str | None, url: str, config: str | None) -> "Config | None":
    """Return the configuration of the display, from the daemon only if the study needs it."""
    from optodrive.device.config_file import load_config

    if participant is None:
        return load_config(config)
    if design.matching is None:
        return None
    from optodrive.client.display import Display

    with Display(url) as display:
        return display.config()


def _simulate(
    design: "Study", out: Path, participants: int, config: "Config | None"
) -> dict[str, list[dict[str, Any]]]:
    """Run the sessions of simulated participants and return the records of their trials."""
    from optodrive.planning.display_model import DisplayModel
    from optodrive.study.dataset import build_log_path
    from optodrive.study.observers import Observer, Participant
    from optodrive.study.presenter import VirtualPresenter
    from optodrive.study.session import SimulatedRespondent, build_matching_model, run_session
    from optodrive.study.study_file import SIMULATED_PREFIX
    from optodrive.study.trial_log import TrialLog
    from optodrive.study.trial_stimulus import check_stimuli

    if design.simulation is None or config is None:
        raise InputError(f"study {design.name}: simulation", None, "an observer, to simulate a participant")
    check_stimuli(design, config)
    display, sessions = DisplayModel.from_config(config), {}
    announce_compilation()
    with show_progress("simulating") as on_progress:
        runs = [(number, session) for number in range(1, participants + 1) for session in range(1, design.sessions + 1)]
        for done, (number, session) in enumerate(runs, start=1):
            name = f"{SIMULATED_PREFIX}{number:02}"
            with TrialLog(build_log_path(out, design, name, session), design, name, session) as log:
                if not log.is_ended:
                    log.begin_run("simulated board in virtual time")
                    presenter = VirtualPresenter(display)
                    sensitivity = _draw_sensitivity(design, number, display.layout)
                    observer = Observer(design, display, Participant(), sensitivity)
                    respondent = SimulatedRespondent(observer, design.seed, number, presenter, session)
                    section = design.matching
                    matched = None if section is None else build_matching_model(section, display.layout)
                    run_session(design, log, presenter, respondent, matching=matched)
                    presenter.close()
                sessions[_name_session(design, name, session)] = list(log.trials.values())
            on_progress(done / len(runs))
    return sessions


def _name_session(design: "Study", participant: str, session: int) -> str:
    """Return the participant's code, with the session in a study of several."""
    return participant if design.sessions == 1 else f"{participant}_ses-{session}"


def _draw_sensitivity(design: "Study", number: int, layout: "PixelLayout") -> "FloatArray":
    """Return the sensitivity of a simulated participant at each pixel, [p]."""
    import numpy as np

    from optodrive.study.observers import draw_sensitivity

    sensitivity_range = 1.0 if design.simulation is None else design.simulation.sensitivity_range
    return draw_sensitivity(layout, sensitivity_range, np.random.default_rng((design.seed, number)))


def _write_sensitivity(
    design: "Study",
    matching: "MatchingSection",
    sessions: dict[str, list[dict[str, Any]]],
    out: Path,
    config: "Config",
) -> dict[str, dict[str, Any]]:
    """Write the sensitivity map of each participant and return its figures."""
    from optodrive.device.config import build_pixel_layout
    from optodrive.study.results import compute_variation, write_sensitivity
    from optodrive.study.study_file import SIMULATED_PREFIX

    found: dict[str, dict[str, Any]] = {}
    for name, records in sessions.items():
        path, known = write_sensitivity(out, design, matching, name, records, config)
        found[name] = {
            "low": float(known.sensitivity.min()),
            "high": float(known.sensitivity.max()),
            "uncertainty": float((known.sigma / known.sensitivity).mean()),
            "written": str(path),
        }
        if name.startswith(SIMULATED_PREFIX):
            number = int(name.removeprefix(SIMULATED_PREFIX).partition("_")[0])
            truth = _draw_sensitivity(design, number, build_pixel_layout(config.display))
            found[name]["variation"] = compute_variation(truth, 1.0, matching.intensity)
            found[name]["residual_variation"] = compute_variation(truth, known.sensitivity, matching.intensity)
    return found


def _run_person(
    design: "Study",
    out: Path,
    participant: str,
    session: int,
    url: str,
    hold: bool,
    lsl: bool,
    page: str | None,
    config: "Config | None",
) -> list[dict[str, Any]]:
    """Run a person's session and return the records of the trials."""
    from optodrive.client.display import Display
    from optodrive.device.config import build_pixel_layout
    from optodrive.study.daemon_presenter import DaemonPresenter
    from optodrive.study.dataset import build_log_path
    from optodrive.study.lab_streams import LabStreams, PublishingPresenter
    from optodrive.study.page_messages import parse_page_address
    from optodrive.study.session import build_matching_model, run_session
    from optodrive.study.terminal import TerminalRespondent
    from optodrive.study.trial_log import TrialLog
    from optodrive.study.trial_stimulus import check_stimuli

    address = None if page is None else parse_page_address("--page", page)
    with ExitStack() as stack:
        log = stack.enter_context(
            TrialLog(build_log_path(out, design, participant, session), design, participant, session)
        )
        if log.is_ended:
            return list(log.trials.values())
        display = stack.enter_context(Display(url))  # stops what was started, also after an error
        check_stimuli(design, display.config())
        if hold:
            display.arm(hold=True)
        elif not (board := display.state().board).is_armed:
            raise NotReadyError(f"the board is {board.state}; arm it first (`optodrive arm`), or add --hold")
        presenter: Presenter = DaemonPresenter(display, {"study": design.name, "participant": participant})
        respondent: Respondent = TerminalRespondent(design, _read_line, _say)
        on_trial: list[Callable[[dict[str, Any]], None]] = []
        streams = LabStreams(design.name, participant) if lsl else None
        if streams is not None:
            print(f"waiting for a recorder of {' and '.join(streams.names)}", file=sys.stderr, flush=True)
            streams.wait_for_recorder()
            presenter = PublishingPresenter(presenter, streams)
            on_trial.append(streams.publish_trial)
        if address is not None:
            respondent = pages = stack.enter_context(_serve_pages(design, participant, log, address, url))
            on_trial.append(pages.record_trial)
        log.begin_run(url)
        try:
            matched = None
            if design.matching is not None and config is not None:
                matched = build_matching_model(design.matching, build_pixel_layout(config.display))
            run_session(design, log, presenter, respondent, partial(_call_all, on_trial), matched)
            if streams is not None:
                streams.finish()
        except EOFError:
            found = Unquoted("the end of the input")
            raise InputError("answer", found, "a line; the session goes on with the same command") from None
        return list(log.trials.values())


@contextmanager
def _serve_pages(
    design: "Study", participant: str, log: "TrialLog", address: "PageAddress", url: str
) -> Iterator["PageRespondent"]:
    """Serve the pages of the session and print their addresses."""
    from optodrive.study.page_respondent import PageRespondent
    from optodrive.study.page_server import StudyPages

    respondent = PageRespondent(design, participant, log.trials)
    with StudyPages(respondent, address, partial(_stop_display, url)) as pages:
        if not address.is_local:
            warning = "other computers can reach the pages, and answers and secrets travel unencrypted"
            print(f"warning: listening on {address.host}: {warning}", file=sys.stderr)
        print(f"participant      {pages.participant_url}", file=sys.stderr)
        print(f"operator         {pages.operator_url}", file=sys.stderr, flush=True)
        yield respondent


def _stop_display(url: str) -> None:
    """Stop as `optodrive stop` does: at the link process, else at the daemon."""
    from optodrive.cli.direct_stop import stop_directly
    from optodrive.client.display import Display

    if stop_directly(url) is None:
        with Display(url) as display:
            display.stop()


def _say(text: str) -> None:
    print(text, end="", file=sys.stderr, flush=True)  # stdout has the report


def _read_line(prompt: str) -> str:
    _say(prompt)
    return input()


def _call_all(listeners: Sequence[Callable[[dict[str, Any]], None]], record: dict[str, Any]) -> None:
    for listener in listeners:
        listener(record)


def _build_report(design: "Study", sessions: dict[str, list[dict[str, Any]]], out: Path) -> dict[str, Any]:
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


def _format_report(report: dict[str, Any]) -> Iterator[str]:
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
