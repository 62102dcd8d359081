"""`optodrive study run | power | report`: run a study with people or simulated participants.

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
from optodrive.cli.study_numbers import PARTICIPANTS_MAX, STUDY_HELP, build_summary, format_summary, power, report
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
    from optodrive.study.study_file import SIMULATED_PREFIX, load_study, name_lines
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
        with name_lines(source):
            if participant is None:
                sessions = _simulate(design, out, participants, display_config)
            else:
                person = participant, session or 1
                records = _run_person(design, out, *person, url, hold, lsl, page, display_config)
                sessions = {_name_session(design, *person): records}
    except BaseException:  # a session that has not ended has tables, too
        with suppress(InputError):
            if (out / "sourcedata").is_dir():
                write_dataset(out)
        raise
    write_dataset(out)
    summary = build_summary(design, sessions, out)
    if design.matching is not None and display_config is not None:
        summary["sensitivity"] = _write_sensitivity(design, design.matching, sessions, out, display_config)
    print_answer(summary, format_summary(summary), json)


GROUP.command()(power)
GROUP.command()(report)


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
