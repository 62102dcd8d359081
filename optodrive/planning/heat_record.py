"""Record of a display's heat between runs of the program: one per machine and display, shared by all users.

Theory of operation

Problem. A display that one process has warmed must be warm for the next one, for every user and every address of the
device. What a process cannot know must never count as cold.

Trust. A record counts only if everybody could have written it: a file of mode 0666 with one name, in a folder of mode
1777, whose content is whole, of this version and of this display's model. A user who cannot write it plays from a hot
display, and leaves no false record behind, because what one user cannot write counts for no other user either. A file
whose status changed after its last write (chmod and back, or a copy from a backup) counts no more. Where others may
trust a file that this process cannot write, it emits nothing.

Identity. A display is known by the laser DAC, or by the uids of all boards, that draw it. A use of a board ends
every other record that names it: a record of a part of the stages, or of more. What draws a part alone never counts as
recorded, because another part may have warmed the display since.

Hot. Without a record the display is as warm as its caps permit, and cools by the model from then on.

Writing. One process at a time holds the file's lock. Before the first light it writes that the display is in use, after
the last light the state; what dies in between leaves a display in use, which is hot. A torn write fails the checksum.

Time is the computer's uptime, which nobody sets and which counts while it sleeps. After a restart the state is that of
the restart: how long the computer was off is what a clock says that may have been set.
"""

import errno
import fcntl
import io
import os
import re
import stat
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from dataclasses import fields, replace
from hashlib import sha256
from math import inf
from pathlib import Path
from typing import Any, Self
from zipfile import BadZipFile

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, refuse_os_error
from optodrive.core.quantity import format_quantity
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.plans import BudgetState
from optodrive.device.config import Config
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import build_cold_budget_state, shift_state

FOLDER = Path("/var/tmp/optodrive-heat")  # noqa: S108 - shared on purpose: see "Trust"
MAGIC = b"optodrive-heat 7\n"
BYTES_MAX = 64_000_000
SHARED_FOLDER, SHARED_FILE = 0o1777, 0o666
# In a folder that all may write, a name may be a link or a pipe: the first is refused, the second does not wait.
FILE_FLAGS = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
OPEN_TRIES = 5
LOCK_TIMEOUT_S, LOCK_POLL_S = 5.0, 0.05
RECENT = tuple(item.name for item in fields(BudgetState) if item.name.startswith("recent_"))
"""Columns whose length is not that of the display."""
# e⁻³: by then a hot panel has lost 95 % of its rise, and what is said of it is no news.
COOLING_TAUS = 3.0
BOARDS = "board"
"""Kind of a display that boards draw. Its identity is that of `join_uids`."""
LIGHTLESS = frozenset(name.encode("ascii").hex() for name in ("simulated001", "host board 1"))
"""Uids of boards that are programs: they heat nothing, so that each of their starts is cold."""
UNKNOWN_UID = "0" * 24
"""Uid of the board of a laser DAC that does not say which one it is."""
PART = "part"


class _UncountedError(Exception):
    """A record counts for no user, for the stated reason."""


RECORD_ERRORS = (_UncountedError, OSError, ValueError, EOFError, KeyError, BadZipFile)


def read_boot() -> tuple[str, float]:
    """Return the identity of the computer's present run, '' if it is hidden, and the time since its start, s."""
    boot = ""
    with suppress(OSError):
        boot = Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
    return boot, time.clock_gettime(time.CLOCK_BOOTTIME)


def join_uids(uids: Iterable[str], is_part: bool = False) -> str:
    """Return the identity of a display by the uids of its boards, '' for one that nothing heats.

    is_part: whether further boards draw on the same display
    """
    joined = "-".join(sorted(set(uids)))
    return "" if LIGHTLESS.issuperset(uids) else f"{joined}-{PART}" if is_part else joined


def identify_display(config: Config, uids: Iterable[str], is_part: bool = False) -> tuple[str, str | None]:
    """Return kind and identity of a display for `HeatRecord`, by the uids of its boards or that of its laser DAC."""
    identity = join_uids(uids, is_part)
    if not config.board.is_dac:
        return BOARDS, identity
    return config.board.transport, None if identity == UNKNOWN_UID else identity


class HeatRecord:
    """The record of one display, locked as long as it is open.

    kind: of device; identity: what the device says it is, None if it cannot be known: then no device of this kind has a
    record any more, because it may be each of them; '' if nothing heats it: then nothing is recorded
    owner: mark of a run of the program, which resume() compares
    hot_reason: why the display counts as hot, '' if the record says how warm it is
    """

    def __init__(
        self,
        kind: str,
        identity: str | None,
        display: DisplayModel,
        clock: Clock,
        on_wait: Callable[[], None] = lambda: None,
        owner: str = "",
    ) -> None:
        self.hot_reason = self._cooling_reason = ""
        self._cooled_s = -inf
        self._kind, self._identity, self._owner = kind, identity, owner
        self._name = f"{kind}-{re.sub('[^0-9A-Za-z._]+', '-', identity or '')}"
        self._budget = display.budget
        self._cold = build_cold_budget_state(len(display.pixels), stage_count=len(display.scan_heads))
        self._model = _digest_model(display)
        self._clock, self._on_wait = clock, on_wait
        self._file: int | None = None
        self._exit_stack = ExitStack()

    @property
    def path(self) -> Path:
        """Path of the file."""
        return FOLDER / self._name

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *details: object) -> None:
        self.close()

    def open(self) -> Self:
        """Open and lock the record. Raise InputError where others may trust a record that cannot be written."""
        if self._identity == "":
            return self
        try:
            with self._exit_stack:
                folder = self._open_folder()
                if self._identity is None:
                    # Any device of its kind may be the one that it warms now.
                    self._forget_all(folder, lambda name: name.startswith(f"{self._kind}-"))
                    raise _UncountedError("the device does not say which one it is")
                self._file = self._open_file(folder, self._name)
                self._exit_stack.callback(os.close, self._file)
                # Before anything is written: the file's status still tells who could have changed it.
                self._judge(self._file)
                if self._kind == BOARDS:
                    # A board of this display in another record: what is drawn now is not in that one.
                    self._forget_all(folder, self._shares_board)
                self._exit_stack = self._exit_stack.pop_all()
        except _UncountedError as error:
            self.hot_reason = str(error)
        return self

    def close(self) -> None:
        """Release the record."""
        self._exit_stack.close()
        self._file = None

    # --- files --------------------------------------------------------------------------------------------------

    def _open_folder(self) -> int:
        with suppress(OSError):
            # Closed until chmod: mkdir's mode passes through the umask, and a half-open folder would be trusted
            # wrongly.
            FOLDER.mkdir(mode=0o700)
            FOLDER.chmod(SHARED_FOLDER)
        try:
            folder = os.open(FOLDER, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        except OSError as error:
            with suppress(OSError):
                self._require_uncounted(FOLDER.lstat(), stat.S_ISDIR, SHARED_FOLDER, FOLDER, error)
            raise _UncountedError(f"{FOLDER}: {error.strerror}") from None
        self._exit_stack.callback(os.close, folder)
        if not _has_mode(os.fstat(folder), SHARED_FOLDER):
            try:
                os.fchmod(folder, SHARED_FOLDER)
            except OSError:
                mode = stat.S_IMODE(os.fstat(folder).st_mode)
                raise _UncountedError(f"{FOLDER} has mode {mode:04o}; it needs {SHARED_FOLDER:04o}") from None
            self._forget_all(folder, lambda name: True)  # others may have played meanwhile
        return folder

    def _shares_board(self, name: str) -> bool:
        """Return whether another record names a board of this one."""
        boards, others = ({*each.split("-")} - {BOARDS, PART} for each in (self._name, name))
        return name != self._name and name.startswith(f"{BOARDS}-") and not boards.isdisjoint(others)

    def _forget_all(self, folder: int, is_meant: Callable[[str], bool]) -> None:
        """Let no record count any more whose name is meant. Wait for those that use one."""
        for name in os.listdir(folder):
            if is_meant(name):
                with suppress(_UncountedError), os.fdopen(self._open_file(folder, name), "rb+") as file:
                    file.truncate(0)

    def _open_file(self, folder: int, name: str) -> int:
        """Open and lock a file, and create it if there is none."""
        for _ in range(OPEN_TRIES):
            try:
                file = os.open(name, FILE_FLAGS, dir_fd=folder)
            except FileNotFoundError:
                self._create(folder, name)
                continue
            except OSError as error:
                self._remove(folder, name, error)
                continue
            with ExitStack() as exit_stack:
                exit_stack.callback(os.close, file)
                status = os.fstat(file)
                if not stat.S_ISREG(status.st_mode) or status.st_nlink != 1:
                    self._remove(folder, name, OSError(errno.EINVAL, "no file of its own"))
                    continue
                self._lock(file, FOLDER / name)
                with suppress(FileNotFoundError):
                    named = os.stat(name, dir_fd=folder, follow_symlinks=False)
                    # The name may be another file's by now: the lock would be on one that nobody finds.
                    if os.path.samestat(status, named):
                        exit_stack.pop_all()
                        return file
        raise _UncountedError(f"{FOLDER / name} is replaced all the time")

    def _create(self, folder: int, name: str) -> None:
        try:
            with suppress(FileExistsError):
                # Empty and private first: an empty record is hot, so a process that finds it early reads nothing false.
                file = os.open(name, FILE_FLAGS | os.O_CREAT | os.O_EXCL, 0o600, dir_fd=folder)
                try:
                    os.fchmod(file, SHARED_FILE)
                    os.fsync(folder)
                finally:
                    os.close(file)
        except OSError as error:
            raise _UncountedError(f"{FOLDER / name} cannot be created: {error.strerror}") from None

    def _remove(self, folder: int, name: str, error: OSError) -> None:
        """Remove a link, folder or foreign file that has the name of a record."""
        with suppress(FileNotFoundError):
            status = os.stat(name, dir_fd=folder, follow_symlinks=False)
            self._require_uncounted(status, stat.S_ISREG, SHARED_FILE, FOLDER / name, error)
            try:
                os.unlink(name, dir_fd=folder)
            except OSError:
                raise _UncountedError(f"{FOLDER / name} is another user's: {error.strerror}") from None

    @staticmethod
    def _require_uncounted(
        status: os.stat_result, is_kind: Callable[[int], bool], mode: int, path: Path, error: OSError
    ) -> None:
        """Raise InputError for a file or folder that others may trust and this process cannot write."""
        if (
            is_kind(status.st_mode)
            and _has_mode(status, mode)
            and (stat.S_ISDIR(status.st_mode) or status.st_nlink == 1)
        ):
            raise InputError(str(path), error.strerror, "permission to record the display's heat; nothing is emitted")

    def _lock(self, file: int, path: Path) -> None:
        until_s = self._clock.now_s() + LOCK_TIMEOUT_S
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if self._clock.now_s() > until_s:
                    expected = "no other process that uses the display; end it"
                    raise InputError(str(path), "in use", expected, "busy") from None
                self._on_wait()
                self._clock.sleep(LOCK_POLL_S)
            else:
                return

    def _judge(self, file: int) -> None:
        status = os.fstat(file)
        if not status.st_size:
            self.hot_reason = "this machine had no record of its heat"
        elif not _has_mode(status, SHARED_FILE):
            self.hot_reason = "not every user could write the record of its heat"
        # A write sets both times alike; chmod, link and restore move only the one of status.
        elif status.st_ctime_ns != status.st_mtime_ns:
            self.hot_reason = "the record of its heat was changed after it was written"
        elif self._name.endswith(f"-{PART}"):
            self.hot_reason = "the boards of its other stages may have warmed it since"
        with suppress(OSError):  # another user's: it goes on to count for nobody
            if not _has_mode(status, SHARED_FILE):
                os.fchmod(file, SHARED_FILE)

    # --- content ------------------------------------------------------------------------------------------------

    def load(self) -> BudgetState:
        """Return the budget state with its zero now: the recorded one, or that of a hot display.

        A hot display is recorded, so that it cools from now on. hot_reason is known afterwards.
        """
        if self._identity == "":
            return self._cold
        boot, now_s = read_boot()
        if not self.hot_reason and self._file is not None:
            try:
                return self._parse(_read(self._file), boot, now_s)
            except RECORD_ERRORS as error:
                self.hot_reason = (
                    str(error) if isinstance(error, _UncountedError) else "the record of its heat was damaged"
                )
        hot = build_hot_budget_state(self._cold, self._budget)
        self._cooling_reason = self.hot_reason
        self._cooled_s = now_s + COOLING_TAUS * float(self._budget.heat.panel_tau_s.max())
        # So that it cools: read again in a minute, the display counts as a minute cooler, not as hot anew.
        self.save(hot)
        return hot

    def resume(self) -> bool:
        """Return whether this owner wrote the record last, whose own knowledge is then as new."""
        if self.hot_reason or self._file is None:
            return False
        try:
            arrays = self._read_arrays(_read(self._file))
            self._recall_cooling(arrays, *read_boot())
        except RECORD_ERRORS:
            return False
        return bool(self._owner) and str(arrays["owner"]) == self._owner

    def _parse(self, data: bytes, boot: str, now_s: float) -> BudgetState:
        arrays = self._read_arrays(data)
        self._recall_cooling(arrays, boot, now_s)
        if "at_s" not in arrays:
            raise _UncountedError("the process that used it last was killed")
        if str(arrays["model"]) != self._model:
            raise _UncountedError("the record of its heat was of another configuration")
        state = BudgetState(**{item.name: self._read_column(arrays, item.name) for item in fields(BudgetState)})
        if not boot or not str(arrays["boot"]):
            raise _UncountedError("this computer hides since when it runs")
        if str(arrays["boot"]) != boot:
            # Another boot: how long the computer was off is unknown, so it has cooled since this start only.
            return shift_state(state, -max(state.at_s, 0.0) - now_s)
        zero_s = float(arrays["zero_s"])
        # Also true for NaN, which would pass `zero_s > now_s`.
        if not zero_s <= now_s:
            raise _UncountedError("the record of its heat is of a time to come")
        return shift_state(state, zero_s - now_s)

    @staticmethod
    def _read_arrays(data: bytes) -> dict[str, Any]:
        digest_end = len(MAGIC) + sha256().digest_size
        if not data.startswith(MAGIC):
            raise _UncountedError("the record of its heat was of another version")
        if sha256(data[digest_end:]).digest() != data[len(MAGIC) : digest_end]:
            raise _UncountedError("the record of its heat was damaged")
        with np.load(io.BytesIO(data[digest_end:])) as table:
            return {key: table[key] for key in table.files}

    def _recall_cooling(self, arrays: dict[str, Any], boot: str, now_s: float) -> None:
        """Keep why the display counted as hot, and until when it cools from that."""
        is_same = bool(boot) and str(arrays["boot"]) == boot
        since_s = float(arrays["written_s"]) if is_same else 0.0
        self._cooled_s, self._cooling_reason = since_s + float(arrays["cooling_s"]), str(arrays["cooling_reason"])

    def _read_column(self, arrays: dict[str, Any], name: str) -> Any:
        """Return numbers of the type and shape of another state's: NaN would pass every comparison of the limiter."""
        stored, expected = arrays[name], np.asarray(getattr(self._cold, name))
        fits = stored.dtype == expected.dtype and stored.ndim == expected.ndim
        if not fits or (stored.shape != expected.shape and name not in RECENT) or np.isnan(stored).any():
            raise _UncountedError("the record of its heat was damaged")
        return float(stored) if stored.ndim == 0 else stored

    def begin_use(self) -> None:
        """Record that the display is in use, before the first light. Raise InputError if that cannot be written."""
        self._write(None, 0.0)

    def save(self, budget: BudgetState, zero_age_s: float = 0.0) -> None:
        """Record the state after the last light, else leave the display in use. zero_age_s: time since its zero, s."""
        with suppress(InputError):
            self._write(budget, read_boot()[1] - zero_age_s)

    def _write(self, budget: BudgetState | None, zero_s: float) -> None:
        if self._file is None:
            return
        columns: dict[str, Any] = {}
        if budget is not None:
            columns = {item.name: getattr(budget, item.name) for item in fields(BudgetState)}
        buffer, (boot, now_s) = io.BytesIO(), read_boot()
        columns |= {"cooling_s": max(0.0, self._cooled_s - now_s), "cooling_reason": self._cooling_reason}
        columns |= {"boot": boot, "written_s": now_s, "zero_s": zero_s, "model": self._model, "owner": self._owner}
        np.savez(buffer, **columns)
        payload = buffer.getvalue()
        data = MAGIC + sha256(payload).digest() + payload
        with refuse_os_error(self.path, "a file that can be written; nothing is emitted"):
            # In place and not by rename: the lock and the status of this very file are the trust.
            os.ftruncate(self._file, len(data))
            written = 0
            while written < len(data):
                written += os.pwrite(self._file, data[written:], written)
            # On the disk before light: a computer that loses power then finds a display in use, which is hot.
            os.fsync(self._file)

    def describe(self) -> str:
        """Return how warm the display counts, and why, in one line, after load()."""
        reason, cooling_s = self.read_cooling()
        if not cooling_s:
            return "recorded"
        word = "hot" if self.hot_reason else "still warm"
        return f"{word}, because {reason}; it cools within {format_quantity(cooling_s, 's')}"

    def read_cooling(self) -> tuple[str, float]:
        """Return why the display counted as hot, and for how long it still cools from that, s, after load()."""
        cooling_s = max(0.0, self._cooled_s - read_boot()[1])
        return (self._cooling_reason, cooling_s) if cooling_s else ("", 0.0)


def read_heat(kind: str, identity: str | None, display: DisplayModel, clock: Clock) -> tuple[bool, str]:
    """Return whether a display has a record and is not hot, and how warm it counts. One without cools from now on."""
    with HeatRecord(kind, identity, display, clock) as record:
        record.load()
        return not record.read_cooling()[1], record.describe()


def _has_mode(status: os.stat_result, mode: int) -> bool:
    return status.st_mode & mode == mode


def _read(file: int) -> bytes:
    with os.fdopen(os.dup(file), "rb") as stream:
        stream.seek(0)
        return stream.read(BYTES_MAX)


def _digest_model(display: DisplayModel) -> str:
    """Return a digest of all that a state is a bound for: the thermal model and the pixels' places."""
    digest = sha256()
    for value in (*display.budget.heat, display.layout.x_m, display.layout.y_m):
        digest.update(np.ascontiguousarray(value, dtype=np.float64).tobytes() + b"|")
    return digest.hexdigest()


def build_hot_budget_state(cold: BudgetState, budget: Budget) -> BudgetState:
    """Return a bound on every state that the caps permit, at time 0 with the gate off. cold: a state of this display.

    All caps are full at once, which no light reaches: walls and touch surfaces stand above a panel that has itself the
    touch surface's cap. Heat that is under way from the absorbers counts as arrived, as in every state.
    """
    caps, heat, pixels = budget.caps, budget.heat, len(cold.rise_k)
    stages = len(cold.beam_end_s)
    has_walls, has_touch = heat.wall_k_per_j.max() > 0.0, heat.touch_k_per_j.max() > 0.0
    wall_k = min(caps.wall_k, caps.touch_k) + heat.wall_transit_credit * caps.absorber_k if has_walls else 0.0
    touch_k = caps.touch_k + heat.touch_transit_credit * caps.absorber_k if has_touch else 0.0
    neighbours: FloatArray = (heat.neighbours >= 0).sum(axis=1).astype(np.float64)
    energy_j = max(caps.pixel_mean_w * caps.pixel_window_s, caps.display_mean_w * caps.display_window_s / pixels)
    recent = pixels * stages
    return replace(
        cold,
        rise_k=np.full(pixels, caps.absorber_k),
        bucket_j=np.full(pixels, caps.pulse_energy_j),
        merged_width_s=np.full(pixels, caps.pulse_width_s),
        wall_k=np.full((pixels, 2), wall_k),
        touch_k=np.full((pixels, 2), touch_k),
        inflow_w=heat.lateral_w_per_k * heat.wall_specht_ratio * wall_k * neighbours,
        exchanged_at_s=0.0,
        # The panel at the touch cap, and everything on it at its own: more than any light reaches.
        panel_k=np.full(2, caps.touch_k / heat.touch_per_panel),
        galvo_mean_square=np.full((stages, 2), caps.galvo_rad2_per_s4),
        recent_start_s=np.full(recent, -caps.pulse_width_s),
        recent_width_s=np.full(recent, caps.pulse_width_s),
        recent_power_w=np.full(recent, energy_j / caps.pulse_width_s),
        recent_pixel=np.tile(np.arange(pixels, dtype=np.int64), stages),
        recent_stage=np.repeat(np.arange(stages, dtype=np.int64), pixels),
    )
