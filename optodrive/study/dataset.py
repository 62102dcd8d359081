"""Datasets in the Brain Imaging Data Structure (BIDS), built from the logs of sessions.

A dataset's folder holds the logs under `sourcedata`, and one table of trials with its description per participant and
task under `sub-ID/beh`. Tables are always written anew from the logs, so that an interrupted run leaves nothing wrong.
"""

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.files import create_folder, lock_folder, read_regular_file, write_text
from optodrive.core.numeric_tables import escape_formula
from optodrive.study.study_file import MATCHED_PARAMETERS, SIMULATED_PREFIX, Study
from optodrive.study.trial_log import has_stimuli, read_log

BIDS_VERSION = "1.10.0"
LOG_SUFFIX = "_trials.jsonl"
ID_MAX = 20
PARTICIPANTS = "participants.tsv"
TABLE_BYTES_MAX = 1_000_000

README = """# Tactile studies

Trials of studies that `optodrive study` ran on an optotactile display.

- `sub-*/beh/*_beh.tsv` has one row per trial, in the order of the session. The `.json` beside it describes its columns,
  the question, the answers and the design.
- `sourcedata/sub-*/*_trials.jsonl` are the logs from which these tables are built: every stimulus as requested and as
  the display executed it, pulse by pulse, every attempt, and every answer.
- Participants are known by identifiers only. Those that begin with `sim` are simulated.
"""

COLUMNS: dict[str, dict[str, Any]] = {
    "trial": {"Description": "Number of the trial in the session's order, from 1"},
    "run": {"Description": "Number of the program's run; a session that was interrupted has several"},
    "attempt": {
        "Description": "Number of the attempt that counts; more than 1 after an interruption or a failed stimulus"
    },
    "answer": {"Description": "The participant's answer"},
    "correct_answer": {"Description": "The answer that is correct; n/a where none is"},
    "is_correct": {"Description": "Whether the answer is the correct one", "Levels": {"0": "no", "1": "yes"}},
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
        "which begins anew when the board restarts",
        "Units": "s",
    },
    "stimulus_duration": {"Description": "Time from the first pulse's start to the last one's end", "Units": "s"},
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
    for path in folder.glob("sourcedata/sub-*"):
        known = path.name.removeprefix("sub-")
        if known != participant and known.casefold() == participant.casefold():
            raise InputError(option, participant, f"{known}, as the dataset spells it, or another identifier")


def build_log_path(folder: Path, study: Study, participant: str) -> Path:
    """Return the path of a session's log in a dataset, and create its folder."""
    sub = f"sub-{participant}"
    create_folder(folder / "sourcedata" / sub)
    return folder / "sourcedata" / sub / f"{sub}_task-{study.task}{LOG_SUFFIX}"


def write_dataset(folder: Path) -> None:
    """Write the tables of all logs of a dataset with a stimulus. A description and a README that exist are kept."""
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
        for path in logs:
            _write_task(folder, path)


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


def _write_task(folder: Path, path: Path) -> None:
    head, trials = read_log(path)
    beh = folder / path.parent.name / "beh"
    create_folder(beh)
    stem, parameters = path.name.removesuffix(LOG_SUFFIX) + "_beh", list(_list_parameters(head["study"]))
    rows = [_build_row(record, parameters) for record in trials]
    write_text(beh / f"{stem}.tsv", _format_table([*list(COLUMNS)[:3], *parameters, *list(COLUMNS)[3:]], rows))
    write_text(beh / f"{stem}.json", _dump(_describe_task(head["study"])))


def _build_row(record: Mapping[str, Any], parameters: Sequence[str]) -> list[str]:
    last = record["presentations"][-1]
    executed, correct = last["executed"], record["is_correct"]
    ends_s = [start_s + width_s for start_s, width_s in zip(executed["start_s"], executed["width_s"], strict=True)]
    cells = [
        record["trial"] + 1,
        record["run"],
        record["attempt"],
        *(record["requested"]["parameters"][name] for name in parameters),
    ]
    cells += [record["answer"], record.get("correct_answer") or "n/a", "n/a" if correct is None else int(correct)]
    cells += [record["response_time_s"]]
    cells += ["n/a" if record.get(name) is None else record[name] for name in ("response_latency_s", "early_answers")]
    requested = last.get("requested") or {}
    cells += [len(record["presentations"]), last["onset_s"], round(max(ends_s), 6), _format_um(last.get("height_m"))]
    cells += [requested.get("onset_s", "n/a"), requested.get("duration_s", "n/a")]
    cells += [_format_um(requested.get("height_m")), len(executed["pixel"])]
    return [str(cell) for cell in cells]


def _format_um(height_m: float | None) -> str:
    return "n/a" if height_m is None else f"{1e6 * height_m:.3f}"


def _describe_task(study: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sidecar of a table: BIDS fields, columns, and the design."""
    response, columns = study["response"], {name: dict(column) for name, column in COLUMNS.items()}
    if response["answers"]:
        columns["answer"]["Levels"] = {escape_formula(answer): answer for answer in response["answers"]}
    else:
        columns["answer"]["Description"] += ", a magnitude between 0 and 1"
    for factor, values in _list_parameters(study).items():
        columns[factor] = {
            "Description": f"Parameter `{factor}` of the stimulus `{study['stimulus']['pattern']}`",
        } | ({"Levels": {escape_formula(str(value)): str(value) for value in values}} if values else {})
    return {
        "TaskName": study["name"].replace("-", ""),
        "TaskDescription": f"{study['title']}: {_describe_procedure(study)}",
        "Instructions": response["question"],
        **columns,
        "Analysis": _describe_analysis(study),
        "StimulusPresentation": {"SoftwareName": "optodrive", "SoftwareVersion": version("optodrive")},
        "Design": study,
    }


def _describe_analysis(study: Mapping[str, Any]) -> dict[str, Any]:
    """Return the guess rate, the column of levels and those of the factors, which an analysis needs."""
    procedure = study.get("procedure")
    return {
        "GuessRate": study["response"]["chance_level"],
        "Level": None if procedure is None else procedure["parameter"],
        "Factors": list(study["factors"]),
    }


def _list_parameters(study: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Return the values of each parameter of the stimulus, none of one that is chosen freely."""
    procedure = study.get("procedure")
    matched: dict[str, list[Any]] = {name: [] for name in MATCHED_PARAMETERS} if study.get("matching") else {}
    constants = {name: [value] for name, value in study["stimulus"]["parameters"].items()}
    levels = {procedure["parameter"]: procedure["levels"]} if procedure else {}
    return {**study["factors"], **levels, **matched, **constants}


def _describe_procedure(study: Mapping[str, Any]) -> str:
    procedure = study.get("procedure")
    if procedure:
        return f"threshold of {procedure['parameter']} by {procedure['kind']}, {procedure['trials']} trials"
    if matching := study.get("matching"):
        return f"comparisons of {matching['places']} places, chosen by the answers, {matching['trials']} trials"
    return f"{study['repetitions']} trials per condition in random order"


def _describe_dataset() -> dict[str, Any]:
    return {
        "Name": "Tactile studies on an optotactile display",
        "BIDSVersion": BIDS_VERSION,
        "DatasetType": "raw",
        "GeneratedBy": [{"Name": "optodrive", "Version": version("optodrive")}],
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
