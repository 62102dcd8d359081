"""Datasets in the Brain Imaging Data Structure (BIDS), built from the logs of sessions.

A dataset's folder holds the logs under `sourcedata`, and one table of trials with its description per participant and
task under `sub-ID/beh`. Tables are always written anew from the logs, so that an interrupted run leaves nothing wrong.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from optodrive import __version__
from optodrive.core.errors import InputError, Unquoted
from optodrive.core.files import create_folder, lock_folder, read_regular_file, write_text
from optodrive.core.numeric_tables import escape_formula
from optodrive.study.study_file import SIMULATED_PREFIX, Study
from optodrive.study.study_sections import QuestionSection
from optodrive.study.threshold import DIFFERENCE_SLOPES, SLOPE_RANGE
from optodrive.study.trial_list import find_exclusion, find_session_exclusion
from optodrive.study.trial_log import has_stimuli, read_records

BIDS_VERSION = "1.10.0"
LOG_SUFFIX = "_trials.jsonl"
ID_MAX = 20
PARTICIPANTS = "participants.tsv"
TABLE_BYTES_MAX = 1_000_000

README = """# Tactile studies

Trials of studies that `optodrive study` ran on an optotactile display.

- `sub-*/beh/*_beh.tsv`, of several sessions `sub-*/ses-*/beh/*_beh.tsv`, has one row per trial, in the order of the
  session. The `.json` beside it describes its columns, the question, the answers and the design.
- Trials with an `exclusion` do not count for the analysis, nor do those of `phase` practice; they are kept and marked.
- `phenotype/*.tsv` are the answers to questionnaires.
- `sourcedata/sub-*/*_trials.jsonl` are the logs from which these tables are built: every stimulus as requested and as
  the display executed it, pulse by pulse, every attempt, and every answer.
- Participants are known by identifiers only. Those that begin with `sim` are simulated.
"""

HEAD: dict[str, dict[str, Any]] = {
    "trial": {"Description": "Number of the trial in the session's list, from 1, with the practice"},
    "run": {"Description": "Number of the program's run; a session that was interrupted has several"},
    "attempt": {
        "Description": "Number of the attempt that counts; more than 1 after an interruption or a failed stimulus"
    },
    "block": {"Description": "Name of the block"},
    "phase": {
        "Description": "Whether the trial is practice",
        "Levels": {"practice": "before the first block", "main": "a trial of the design"},
    },
    "is_catch": {
        "Description": "Whether it is a catch trial, whose stimulus is replaced by nothing or by equal intervals",
        "Levels": {"0": "no", "1": "yes"},
    },
}
"""Columns before those of the parameters of the stimulus."""
COLUMNS: dict[str, dict[str, Any]] = {
    "intervals": {
        "Description": "Names of the intervals in the order in which they were shown, n/a for a trial of one part"
    },
    "answer": {"Description": "The participant's answer, n/a if there was none in time"},
    "chosen_interval": {"Description": "Name of the interval that the answer names, n/a if answers name no interval"},
    "correct_answer": {"Description": "The correct answer, n/a if none is correct"},
    "is_correct": {"Description": "Whether the answer is the correct one", "Levels": {"0": "no", "1": "yes"}},
    "exclusion": {
        "Description": "Rule of the study by which the trial is excluded from the analysis, n/a if it is not",
        "Levels": {
            "no_answer": "no answer within the longest response time",
            "too_fast": "a response time below the shortest one",
            "practice": "the practice of this session ended without its criterion",
            "catch_trials": "too many wrong answers to the catch trials of this session",
        },
    },
    "response_time": {"Description": "Time from the end of the stimulus to the answer", "Units": "s"},
    "response_latency": {
        "Description": "Part of the response time that the way of the answer through browser and network may have "
        "taken: the browser's delay after the key or touch, plus a round trip to it; n/a without a page",
        "Units": "s",
    },
    "early_answers": {
        "Description": "Number of answers before the end of the stimulus, which do not count; n/a without a page"
    },
    "presentations": {"Description": "Number of times for which the stimulus was shown before the answer"},
    "stimulus_onset": {
        "Description": "Gate on of the first pulse of the last presentation, by the clock of the display's board, "
        "which begins anew when the board restarts; n/a if nothing was shown",
        "Units": "s",
    },
    "stimulus_duration": {
        "Description": "Time from the first pulse's start to the end of the last one, or of an empty last interval",
        "Units": "s",
    },
    "stimulus_height": {
        "Description": "Largest displacement of any pixel by the executed pulses, as the thermal model computes it",
        "Units": "um",
    },
    "requested_onset": {
        "Description": "Time at which the last presentation was due, by the clock of stimulus_onset",
        "Units": "s",
    },
    "requested_duration": {"Description": "Duration of the stimulus as requested", "Units": "s"},
    "requested_height": {
        "Description": "Largest displacement that the stimulus requests; n/a of a stimulus stated by power",
        "Units": "um",
    },
    "executed_pulses": {"Description": "Number of light pulses of the last presentation that the board executed"},
}


def check_participant(option: str, participant: str) -> None:
    """Raise InputError unless an identifier is one that a dataset can have."""
    if not (participant.isascii() and participant.isalnum() and len(participant) <= ID_MAX):
        raise InputError(option, participant, f"1 to {ID_MAX} letters and digits, a code and not a name")


def check_new_participant(option: str, folder: Path, participant: str) -> None:
    """Raise InputError for an identifier that a dataset has in other letters: file systems and BIDS confuse them."""
    listed = [Path(name) for name in read_participants(folder)[1]]
    for path in [*folder.glob("sourcedata/sub-*"), *folder.glob("sub-*"), *listed]:
        known = path.name.removeprefix("sub-")
        if known != participant and known.casefold() == participant.casefold():
            raise InputError(option, participant, f"{known}, as the dataset spells it, or another identifier")


def build_log_path(folder: Path, study: Study, participant: str, session: int = 1) -> Path:
    """Return the path of a session's log in a dataset, and create its folder."""
    sub, ses = f"sub-{participant}", f"_ses-{session}" if study.sessions > 1 else ""
    create_folder(folder / "sourcedata" / sub)
    return folder / "sourcedata" / sub / f"{sub}{ses}_task-{study.task}{LOG_SUFFIX}"


def write_dataset(folder: Path) -> None:
    """Write the tables of all logs of a dataset with a stimulus, and of the questionnaires.

    A description and a README that exist are kept.
    """
    with lock_folder(folder):
        logs = [path for path in sorted((folder / "sourcedata").glob(f"sub-*/*{LOG_SUFFIX}")) if has_stimuli(path)]
        for name, text in (
            ("dataset_description.json", _dump(_describe_dataset())),
            ("README.md", README),
            ("participants.json", _dump(_describe_participants())),
        ):
            if not (folder / name).exists():
                write_text(folder / name, text)
        write_text(folder / PARTICIPANTS, _list_participants(folder, sorted({path.parent.name for path in logs})))
        answers: dict[str, list[dict[str, Any]]] = {}
        for path in logs:
            _write_task(folder, path, answers)
        for task, rows in answers.items():
            _write_answers(folder / "phenotype", task, rows)


def read_participants(folder: Path) -> tuple[list[str], dict[str, dict[str, str]]]:
    """Return the columns of a dataset's participants.tsv and its rows by participant, none if there is no such file.

    Raise InputError, with the line, for a table in which a participant has not one row with every column.
    """
    table = folder / PARTICIPANTS
    if not table.exists():
        return ["participant_id"], {}
    try:
        lines = read_regular_file(table, TABLE_BYTES_MAX).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise InputError(str(table), Unquoted("another encoding"), "UTF-8") from None
    rows = [(number, line.split("\t")) for number, line in enumerate(lines, start=1) if line.strip()]
    head = rows[0][1] if rows else []
    if "participant_id" not in head or len(set(head)) < len(head):
        expected = "tab-separated columns that differ, one of them participant_id"
        raise InputError(f"{table}, line 1", lines[0] if lines else Unquoted("an empty file"), expected)
    kept: dict[str, dict[str, str]] = {}
    for number, cells in rows[1:]:
        if len(cells) != len(head):
            found = Unquoted(f"{len(cells)} of {len(head)} cells")
            raise InputError(f"{table}, line {number}", found, "a cell per column, separated by tabs")
        row = dict(zip(head, cells, strict=True))
        if row["participant_id"] in kept:
            raise InputError(f"{table}, line {number}", row["participant_id"], "one row per participant")
        kept[row["participant_id"]] = row
    return head, kept


def _list_participants(folder: Path, participants: list[str]) -> str:
    """Return participants.tsv with a row per participant, and every column and row that others have added."""
    head, kept = read_participants(folder)
    head = head if "kind" in head else [*head, "kind"]
    for one in participants:
        kind = "simulated" if one.startswith(f"sub-{SIMULATED_PREFIX}") else "person"
        kept[one] = {**kept.get(one, {}), "participant_id": one, "kind": kind}
    return "".join(
        "\t".join(cells) + "\n" for cells in [head, *([row.get(name, "n/a") for name in head] for row in kept.values())]
    )


def _write_task(folder: Path, path: Path, answers: dict[str, list[dict[str, Any]]]) -> None:
    """Write the table of a session, and add its questionnaire to those of its task."""
    records = read_records(path)
    study = Study.model_validate(records[0]["study"])
    trials = sorted((each for each in records if each["record"] == "trial"), key=lambda each: int(each["trial"]))
    stem = path.name.removesuffix(LOG_SUFFIX)
    ses = [part for part in stem.split("_") if part.startswith("ses-")]
    beh = folder.joinpath(path.parent.name, *ses, "beh")
    create_folder(beh)
    parameters, excluded = list(study.tabulated), find_session_exclusion(study, trials)
    rows = [_build_row(study, record, parameters, excluded) for record in trials]
    write_text(beh / f"{stem}_beh.tsv", _format_table([*HEAD, *parameters, *COLUMNS], rows))
    write_text(beh / f"{stem}_beh.json", _dump(_describe_task(study)))
    for record in records:
        if record["record"] == "questionnaire":
            row = {
                "participant_id": path.parent.name,
                **({"session_id": ses[0]} if ses else {}),
                "when": record["when"],
            }
            answers.setdefault(study.task, []).append({"study": study, **row, **record["answers"]})


def _write_answers(folder: Path, task: str, rows: list[dict[str, Any]]) -> None:
    """Write the answers to the questionnaires of a task, one row per participant and session."""
    create_folder(folder)
    merged: dict[tuple[str, str], dict[str, Any]] = {}
    questions: dict[str, QuestionSection] = {}
    for row in rows:
        questions |= {question.name: question for question in row["study"].questions}
        key = (row["participant_id"], row.get("session_id", ""))
        merged.setdefault(key, {}).update({name: value for name, value in row.items() if name not in ("study", "when")})
    head = ["participant_id", *(["session_id"] if any("session_id" in row for row in rows) else []), *questions]
    table = [[_to_cell(row.get(name)) for name in head] for row in merged.values()]
    write_text(folder / f"{task}_questionnaire.tsv", _format_table(head, table))
    described = {name: _describe_question(question) for name, question in questions.items()}
    about = {"MeasurementToolMetadata": {"Description": "Questionnaire of a tactile study"}}
    write_text(folder / f"{task}_questionnaire.json", _dump({**about, **described}))


def _describe_question(question: QuestionSection) -> dict[str, Any]:
    levels = {escape_formula(answer): answer for answer in question.answers}
    return {"Description": question.question, **({"Levels": levels} if levels else {})}


def _to_cell(value: object) -> str:
    """Return a value as a cell of a table, n/a for none."""
    return "n/a" if value is None else str(int(value)) if isinstance(value, bool) else str(value)


def _to_um(height_m: float | None) -> str | None:
    return None if height_m is None else f"{1e6 * height_m:.3f}"


def _build_row(study: Study, record: Mapping[str, Any], parameters: Sequence[str], excluded: str | None) -> list[str]:
    last = record["presentations"][-1]
    requested = last["requested"] or {}
    given = {**study.stimulus.parameters, **record["condition"]}
    cells = [record["trial"] + 1, *(record[name] for name in list(HEAD)[1:])]
    cells += [given.get(parameter) for parameter in parameters]
    cells += [",".join(record["intervals"]) or None]
    cells += [record[name] for name in ("answer", "chosen_interval", "correct_answer", "is_correct")]
    cells += [excluded or find_exclusion(study, record), record["response_time_s"]]
    cells += [record["response_latency_s"], record["early_answers"], len(record["presentations"])]
    cells += [last["onset_s"], last["duration_s"], _to_um(last["height_m"])]
    cells += [requested.get("onset_s"), requested.get("duration_s"), _to_um(requested.get("height_m"))]
    cells += [len(last["executed"]["pixel"])]
    return [_to_cell(cell) for cell in cells]


def _describe_task(study: Study) -> dict[str, Any]:
    """Return the sidecar of a table: BIDS fields, columns, and the design."""
    response, columns = study.response, {name: dict(column) for name, column in {**HEAD, **COLUMNS}.items()}
    if response.answers:
        levels = zip(response.answers, response.labels or response.answers, strict=True)
        columns["answer"]["Levels"] = {escape_formula(answer): label for answer, label in levels}
    else:
        scale = "a magnitude between 0 and 1" if response.kind == "magnitude" else "a positive number"
        columns["answer"]["Description"] += f"; {scale}"
    for factor, values in study.tabulated.items():
        shown = f"Parameter `{factor}` of the stimulus" if factor not in study.levels else f"Condition `{factor}`"
        columns[factor] = {"Description": shown} | (
            {"Levels": {escape_formula(str(value)): str(value) for value in values}} if values else {}
        )
    return {
        "TaskName": study.task,
        "TaskDescription": f"{study.title}: {_describe_procedure(study)}",
        "Instructions": "\n\n".join(filter(None, (study.instructions, response.question))),
        **columns,
        "Analysis": {
            "GuessRate": response.chance_level,
            "Level": study.threshold_of,
            "Slopes": SLOPE_RANGE if study.response.level is None else DIFFERENCE_SLOPES,
            "EqualInterval": None if study.procedure is None else study.procedure.equal_interval,
            "Factors": [name for name in study.varied if study.procedure is None or name != study.procedure.parameter],
        },
        "StimulusPresentation": {"SoftwareName": "optodrive", "SoftwareVersion": __version__},
        "Design": study.model_dump(mode="json"),
    }


def _describe_procedure(study: Study) -> str:
    procedure, matching = study.procedure, study.matching
    if procedure is not None:
        sought = "threshold" if procedure.equal_interval is None else f"equality with {procedure.equal_interval}"
        return f"{sought} of {procedure.parameter} by {procedure.kind}, {procedure.trials} trials per block"
    if matching is not None:
        return f"comparisons of {matching.places} places, chosen by the answers, {matching.trials} trials"
    return f"{study.repetitions} trials per condition, order {study.order.trials}"


def _describe_dataset() -> dict[str, Any]:
    return {
        "Name": "Tactile studies on an optotactile display",
        "BIDSVersion": BIDS_VERSION,
        "DatasetType": "raw",
        "GeneratedBy": [{"Name": "optodrive", "Version": __version__}],
    }


def _describe_participants() -> dict[str, Any]:
    return {
        "kind": {
            "Description": "Whether the participant is a person or simulated",
            "Levels": {"person": "a person", "simulated": "a model of a participant"},
        }
    }


def _format_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "".join("\t".join(str(escape_formula(cell)) for cell in row) + "\n" for row in [head, *rows])


def _dump(document: object) -> str:
    return json.dumps(document, indent=2, ensure_ascii=False) + "\n"
