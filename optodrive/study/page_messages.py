"""Messages between the pages of a study and the process that runs it: JSON over a WebSocket of each page."""

from collections.abc import Mapping
from contextlib import suppress
from importlib.resources import files
from ipaddress import ip_address
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, TypeAdapter
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.websockets import WebSocketDisconnect

from optodrive.core.errors import InputError
from optodrive.core.json_model import JsonModel
from optodrive.core.toml_model import Section
from optodrive.daemon.api.error_handlers import send_problem
from optodrive.daemon.api.host_check import LOOPBACK_NAMES, check_host_and_origin
from optodrive.daemon.api.request_limits import App, Receive, Scope, Send, join_headers
from optodrive.daemon.api.static_files import MEDIA_TYPES, SECURITY_HEADERS
from optodrive.study.study_sections import QuestionSection, Value

MESSAGE_MAX_BYTES = 16_384
"""Largest message of a page."""
HANDLED_MAX_S = 60.0
FORM_TEXT_MAX = 200
"""Longest answer to a question of a questionnaire, characters."""

Index = Annotated[int, Field(ge=0)]
Phase = Literal["start", "pause", "form", "example", "stimulus", "question", "rest", "done", "stopped"]
"""The state of the session as a participant sees it.

start: waits for the participant's button; pause: by the operator; form: a questionnaire; example: a stimulus without a
question; rest: between two stimuli, or after the last; stopped: the program ends before the last trial
"""


class PresentationKey(Section):
    """The presentation that an answer is about: trial from 0, attempt and presentation from 1."""

    trial: Index
    attempt: Index
    presentation: Index


class AnswerMessage(PresentationKey):
    """An answer.

    handled_s: time from the key or touch, as the browser stamps it, to the sending of this message
    """

    kind: Literal["answer"]
    answer: str | float
    handled_s: Annotated[float, Field(ge=0.0, le=HANDLED_MAX_S)]


class AgainMessage(PresentationKey):
    """A request to feel the stimulus again."""

    kind: Literal["again"]


class ReadyMessage(Section):
    """The participant is ready for stimuli, or takes a break."""

    kind: Literal["ready", "break"]


class FormMessage(Section):
    """The answers to a questionnaire, by the names of its questions."""

    kind: Literal["form"]
    answers: dict[str, Annotated[str, Field(max_length=FORM_TEXT_MAX)] | float]


class SeenMessage(Section):
    """A page has received the view with this number."""

    kind: Literal["seen"]
    view: Index


class OperatorMessage(Section):
    """A command of the operator: no further stimulus, go on, or stop the display and end the session's run."""

    kind: Literal["pause", "resume", "stop"]


ParticipantMessage = AnswerMessage | AgainMessage | ReadyMessage | FormMessage | SeenMessage
PARTICIPANT_MESSAGES: TypeAdapter[ParticipantMessage] = TypeAdapter(
    Annotated[ParticipantMessage, Field(discriminator="kind")]
)
OPERATOR_MESSAGES: TypeAdapter[OperatorMessage] = TypeAdapter(OperatorMessage)


class ParticipantView(JsonModel):
    """All that the participant's page shows. It never holds a condition.

    labels: what is read in place of each answer; again: whether the stimulus may be felt again
    trial: number of the present or next trial within practice or the other trials, from 1; trials: number of the others
    example: number of the example and of all; announced: the presentation that answers are about
    is_early: there was an answer before the stimulus had ended; answered: the answer that was noted last
    has_missed: there was no answer in time; follows: what comes after a trial, None until that is known
    parts: beginning and end of each interval of the stimulus, s after this view was built; none of a single one
    is_correct, correct: feedback to the last answer; is_begun: the participant was ready before
    texts: the sentences of the page by key
    """

    phase: Phase
    title: str
    language: str
    texts: dict[str, str]
    instructions: str | None
    question: str
    kind: Literal["choice", "magnitude", "number"]
    answers: tuple[str, ...]
    labels: tuple[str, ...]
    again: bool
    questions: tuple[QuestionSection, ...]
    is_practice: bool
    trial: int
    trials: int
    has_missed: bool
    follows: Literal["stimulus", "break", "end"] | None
    parts: tuple[tuple[float, float], ...]
    is_correct: bool | None
    correct: str | None
    example: tuple[int, int] | None
    announced: PresentationKey | None
    is_early: bool
    answered: str | float | None
    is_begun: bool


class TrialRow(JsonModel):
    """A trial that counts, as the operator's page lists it. trial: from 1."""

    trial: int
    attempt: int
    presentations: int
    is_practice: bool
    is_catch: bool
    condition: dict[str, Value]
    answer: str | float | None
    is_correct: bool | None
    response_time_s: float | None
    response_latency_s: float | None
    early_answers: int | None
    pulses: int
    duration_s: float


class Executed(JsonModel):
    """A presentation as the board reports it. fault: how it differs from the request."""

    pulses: int
    duration_s: float
    onset_s: float | None
    fault: str | None


class OperatorView(JsonModel):
    """All that the operator's page shows.

    answered: number of trials that count; rows: the newest of them, in order; notice: of the program, one line
    """

    phase: Phase
    title: str
    participant: str
    stimulus: str
    block: str | None
    is_practice: bool
    is_catch: bool
    trial: int
    trials: int
    example: tuple[int, int] | None
    answered: int
    correct: int | None
    is_present: bool
    is_ready: bool
    is_paused: bool
    announced: PresentationKey | None
    condition: dict[str, Value] | None
    executed: Executed | None
    rows: tuple[TrialRow, ...]
    notice: str


LOOPBACK = "127.0.0.1"


class PageAddress(NamedTuple):
    """Where the pages are served. port: 0 for any free one."""

    host: str
    port: int

    @property
    def is_local(self) -> bool:
        """Whether only programs of this computer reach it, which may also call it by another name."""
        return self.host in LOOPBACK_NAMES


def parse_page_address(option: str, text: str) -> PageAddress:
    """Parse `PORT`, on loopback, or `HOST:PORT`. Raise InputError."""
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdigit() and int(port) <= 65535) or ":" in host:
        raise InputError(option, text, "PORT or HOST:PORT, a port from 0 to 65535")
    with suppress(ValueError):
        if ip_address(host).is_unspecified:
            raise InputError(option, text, "the address by which the participant's device reaches this computer")
    return PageAddress(host or LOOPBACK, int(port))


SHARED_FILES = ("colours.css", "announcer.js")
"""Files of the daemon's page."""


class HostCheck:
    """Refuses requests by Host and Origin, in front of the application."""

    def __init__(self, app: App, hosts: set[str]) -> None:
        self._app, self._hosts = app, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        headers = join_headers((name.decode("latin-1"), value.decode("latin-1")) for name, value in scope["headers"])
        problem = check_host_and_origin(headers, self._hosts)
        if problem is None:
            with suppress(WebSocketDisconnect):  # a page that left while something was sent to it
                await self._app(scope, receive, send)
        else:
            await send_problem(send, problem, "websocket.http" if scope["type"] == "websocket" else "http")


def read_files() -> dict[str, bytes]:
    """Return the content of every file of the pages by its name."""
    contents = {item.name: item.read_bytes() for item in files("optodrive.study").joinpath("page").iterdir()}
    shared = files("optodrive.daemon").joinpath("page")
    return contents | {name: shared.joinpath(name).read_bytes() for name in SHARED_FILES}


def build_response(name: str, contents: Mapping[str, bytes]) -> Response:
    """Return a file of the pages. Raise HTTPException (404) for another name."""
    if name not in contents:
        raise HTTPException(404)
    return Response(contents[name], media_type=MEDIA_TYPES["." + name.rpartition(".")[2]], headers=SECURITY_HEADERS)
