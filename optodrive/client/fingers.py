"""Places of fingertips, reported to a daemon, and scripts of them: CSV files of places with their times."""

import asyncio
from collections.abc import Sequence
from contextlib import AsyncExitStack, suppress
from itertools import groupby
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import ValidationError
from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed

from optodrive.client.exchange import Endpoint
from optodrive.client.problems import build_error
from optodrive.client.sockets import BlockingConnection, open_connection
from optodrive.core.errors import InputError, LinkError, NotReadyError, OptodriveError
from optodrive.core.numeric_tables import read_columns
from optodrive.core.toml_model import build_input_error
from optodrive.core.types.fingers import FingerPlace, FingerReport
from optodrive.core.types.push_options import check_keywords
from optodrive.daemon.responses.messages import FINGERS_MAX, FingerMessage, FingersRefusal, validate_fingers

PATH = "/v1/fingers"


@check_keywords
class AsyncFingers:
    """A tracker's connection that opens when entered. See `Fingers`."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self._exit_stack = AsyncExitStack()
        self._connection: ClientConnection | None = None
        self._reading: asyncio.Task[None] | None = None
        self._refusal: OptodriveError | None = None

    async def __aenter__(self) -> Self:
        self._connection = await open_connection(self._endpoint, PATH, self._exit_stack)
        self._reading = asyncio.create_task(self._read(self._connection))
        return self

    async def __aexit__(self, *details: object) -> None:
        await self.close()

    async def close(self) -> None:
        """See `Fingers.close`."""
        await self._exit_stack.aclose()

    async def send(self, places: Sequence[FingerPlace], age_s: float = 0.0) -> None:
        """See `Fingers.send`."""
        refusal, self._refusal = self._refusal, None
        if refusal is not None:
            raise refusal
        message = validate_fingers({"fingers": [place._asdict() for place in places], "age_s": age_s})
        if self._connection is None:
            raise NotReadyError("the connection of the fingers is not open: `async with display.fingers() as fingers`")
        try:
            await self._connection.send(message.model_dump_json())
        except ConnectionClosed:
            raise LinkError("the daemon has closed the connection of the fingers") from None

    async def _read(self, connection: ClientConnection) -> None:
        """Take refusals. Those that nobody reads would end in a connection that reads no sign of life, and is lost."""
        with suppress(ConnectionClosed):
            async for text in connection:
                self._refusal = build_error(FingersRefusal.model_validate_json(text).problem)


@check_keywords
class Fingers(BlockingConnection[AsyncFingers]):
    """A tracker's connection. `Display.fingers()` builds one: `with display.fingers() as fingers: fingers.send(…)`.

    The daemon knows of no finger once it is closed.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(AsyncFingers(endpoint), "fingers")

    def send(self, places: Sequence[FingerPlace], age_s: float = 0.0) -> None:
        """Report all fingertips, none if there is none. age_s: time since they were there.

        Raise LinkError without a connection, and InputError for a place that the display cannot have. Raise BusyError,
        once, if places before these waited too long to count: the next ones may be sent, less often.
        """
        self._loop.run(self._connection.send(places, age_s))


COLUMNS = ("time_s", "number", "x_m", "y_m", "radius_m")
LIFTED_S = 0.05
"""Time after its last row at which a script that ends with fingers on the display lifts them."""


def read_finger_script(path: Path) -> list[FingerReport]:
    """Read a script. Rows of one time are one report, and at its end all fingers are lifted.

    Raises InputError that names row, column and value.
    """
    table = read_columns(path, COLUMNS)
    if not len(table):
        raise InputError(str(path), "no row", "a row for each fingertip at each time")
    backward = np.flatnonzero(np.diff(table[:, 0], prepend=0.0) < 0.0)
    if len(backward):
        row = int(backward[0])
        raise InputError(
            f"{path}: row {row + 2}: time_s", float(table[row, 0]), "a time of 0 or more, not before the last"
        )
    reports = []
    for at_s, rows in groupby(enumerate(table.tolist(), start=2), lambda numbered: numbered[1][0]):
        places = tuple(_check_place(path, row, values) for row, values in rows)
        if len(places) > FINGERS_MAX:
            raise InputError(f"{path}: time {at_s:g} s", len(places), f"at most {FINGERS_MAX} fingertips")
        reports.append(FingerReport(at_s, places))
    return [*reports, FingerReport(reports[-1].at_s + LIFTED_S, ())]


def _check_place(path: Path, row: int, values: list[float]) -> FingerPlace:
    """Return the fingertip of a row. Raise InputError if the display cannot have it."""
    _, number, *place = values
    members: dict[str, float] = dict(zip(COLUMNS[2:], place, strict=True))
    if number != int(number):
        raise InputError(f"{path}: row {row}: number", number, "a whole number")
    try:
        FingerMessage.model_validate({"number": int(number), **members})
    except ValidationError as error:
        raise build_input_error(error, f"{path}: row {row}") from None
    return FingerPlace(int(number), *place)
