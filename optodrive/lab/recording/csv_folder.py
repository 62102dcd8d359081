"""Recording as a folder: `recording.toml`, and per run a subfolder with `pulses.csv` and one CSV file per signal."""

import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.numeric_tables import CsvTable, open_table
from optodrive.core.toml_model import read_toml
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Run
from optodrive.lab.recording.storage import (
    COMMANDS,
    FORMAT,
    PULSES,
    SAMPLE_COLUMNS,
    SIGNALS,
    TABLE_COLUMNS,
    TEXT_BYTES_MAX,
    VERSION,
    Attributes,
    MemoryBudget,
    RecordingTree,
    convert_errors,
    normalize_attributes,
)

TOML_NAME = "recording.toml"
TOML_BYTES_MAX = 64 * TEXT_BYTES_MAX


class CsvTree(RecordingTree):
    """Recording in a folder of CSV files."""

    def __init__(self, path: Path) -> None:
        """Read `recording.toml`."""
        self.path = path
        self._budget = MemoryBudget()
        described = path / TOML_NAME
        if not described.is_file():
            expected = "a TOML file that describes the recording"
            raise InputError(str(described), Unquoted("no file of this name"), expected)
        self._toml = read_toml(described, TOML_BYTES_MAX)

    def __exit__(self, *details: object) -> None:
        """Do nothing. No file stays open."""

    def read_attributes(self, *names: str) -> Attributes:
        """Return the attributes of the recording, of a run, or of a signal."""
        if not names:
            return normalize_attributes(self._toml)
        table = self._get_run_table(names[0])
        described = table.get(names[1], {}) if len(names) > 1 else table
        return normalize_attributes(described) if isinstance(described, dict) else {}

    def list_runs(self) -> list[str]:
        """Return the run names: tables of `recording.toml`, and folders with pulses that lack a table."""
        with convert_errors(str(self.path), "a readable folder"):
            folders = [entry.name for entry in self.path.iterdir() if (entry / f"{PULSES}.csv").is_file()]
            folder_names = sorted(name for name in folders if not name.startswith("."))
        return list(dict.fromkeys([*self._get_run_tables(), *folder_names]))

    def list_members(self, run: str) -> list[str]:
        """Return the names of a run's tables and signals, from `recording.toml` and from the files."""
        tables = [name for name, value in self._get_run_table(run).items() if isinstance(value, dict)]
        folder = self.path / run
        with convert_errors(self.format_place(run), "a readable folder"):
            files = sorted(folder.glob("*.csv")) if folder.is_dir() else []
        return list(dict.fromkeys([*tables, *(file.stem for file in files if not file.name.startswith("."))]))

    def read_table(self, run: str, name: str) -> FloatArray:
        """Return a table of a run, [n, columns]."""
        return self._read_csv(run, name, TABLE_COLUMNS[name], ())

    def read_samples(self, run: str, signal: str) -> tuple[FloatArray, FloatArray]:
        """Return the times and values of a signal."""
        columns = self._read_csv(run, signal, SAMPLE_COLUMNS, ("value",))
        return columns[:, 0].copy(), columns[:, 1].copy()

    def count_samples(self, run: str, signal: str) -> int:
        """Return the number of samples of a signal by counting rows."""
        with self._open_table(run, signal, SAMPLE_COLUMNS) as table:
            return sum(1 for _ in table.rows())

    def _get_run_table(self, run: str) -> dict[str, Any]:
        return self._get_run_tables().get(run, {})

    def _get_run_tables(self) -> dict[str, dict[str, Any]]:
        runs = self._toml.get("runs")
        if not isinstance(runs, dict) or not all(isinstance(run, dict) for run in runs.values()):
            raise InputError(f"{self.path / TOML_NAME}: runs", runs, "one table per run: [runs.NAME]")
        return runs

    @contextmanager
    def _open_table(self, run: str, name: str, columns: tuple[str, ...]) -> Iterator[CsvTable]:
        """Open a table or a signal, whose value may also have the signal's name."""
        path, place = self.path / run / f"{name}.csv", self.format_place(run, name)
        with convert_errors(place, "a readable file"):
            if not path.is_file():
                raise InputError(place, None, f"the file {run}/{name}.csv")
        with (
            convert_errors(place, f"CSV: {','.join(columns)}"),
            open_table(path, columns, place, {"value": name} if columns == SAMPLE_COLUMNS else {}) as table,
        ):
            yield table

    def _read_csv(self, run: str, name: str, columns: tuple[str, ...], missing: tuple[str, ...]) -> FloatArray:
        place = self.format_place(run, name)
        with self._open_table(run, name, columns) as table:
            return table.read_numbers(missing, lambda: self._budget.reserve(place, len(columns)))


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder that replaces `path` if the block succeeds and is removed if it fails.

    Raises InputError if the folder cannot be written or `path` is a file or a folder with content.
    """
    temporary: Path | None = None
    try:
        if path.is_file() or (path.is_dir() and any(path.iterdir())):
            raise InputError(str(path), Unquoted("an existing file or folder"), "a new or empty folder")
        temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
        yield temporary
        temporary.chmod(0o755)
        temporary.replace(path)
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a writable folder") from None
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


def write_folder(folder: Path, runs: tuple[Run, ...], instrument_notes: str) -> None:
    """Write normalized runs into an empty folder."""
    lines = [f'format = "{FORMAT}"', f"version = {VERSION}"]
    if instrument_notes:
        lines.append(f"instrument_notes = {_format_value(instrument_notes)}")
    for run in runs:
        lines += _format_run(run)
        _write_run(folder / run.name, run)
    (folder / TOML_NAME).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _format_run(run: Run) -> list[str]:
    table = f"runs.{_format_key(run.name)}"
    attributes = {**run.attributes, "ambient_K": run.ambient_k}
    lines = ["", f"[{table}]", *(f"{_format_key(key)} = {_format_value(value)}" for key, value in attributes.items())]
    for name, signal in ((name, run.signals[name]) for name in SIGNALS if name in run.signals):
        lines += ["", f"[{table}.{name}]", f"pixel = {signal.pixel}"]
        lines += [] if signal.sigma is None else [f"sigma = {_format_value(signal.sigma)}"]
    return lines


def _format_key(key: str) -> str:
    bare = key.isascii() and key.replace("_", "").replace("-", "").isalnum()
    return key if bare else _format_value(key)


def _format_value(value: str | float) -> str:
    if isinstance(value, str):
        # JSON escapes are valid in TOML; JSON leaves only the control character DEL unescaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)


def _write_run(folder: Path, run: Run) -> None:
    folder.mkdir()
    _write_csv(folder / f"{PULSES}.csv", TABLE_COLUMNS[PULSES], run.pulses)
    if run.commands is not None:
        _write_csv(folder / f"{COMMANDS}.csv", TABLE_COLUMNS[COMMANDS], run.commands)
    for name, signal in run.signals.items():
        _write_csv(folder / f"{name}.csv", SAMPLE_COLUMNS, np.column_stack([signal.t_s, signal.value]))


def _write_csv(path: Path, columns: tuple[str, ...], rows: FloatArray) -> None:
    with path.open("w", encoding="ascii", newline="") as file:
        file.write(",".join(columns) + "\n")
        # `repr` gives the shortest digits that read back as the same number. The last column is a pixel or a value.
        rest = "nan" if columns == SAMPLE_COLUMNS else ".0"
        file.writelines(f"{','.join(map(repr, row)).removesuffix(rest)}\n" for row in rows.tolist())
