"""Messages between the pages of a study and the process that runs it: JSON over a WebSocket of each page."""

from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from optodrive.core.json_model import JsonModel
from optodrive.core.toml_model import Section
from optodrive.study.study_file import Value

MESSAGE_MAX_BYTES = 1024
"""Largest message of a page."""
HANDLED_MAX_S = 60.0

Index = Annotated[int, Field(ge=0)]
Phase = Literal["start", "pause", "example", "stimulus", "question", "rest", "done", "stopped"]
"""The state of the session as a participant sees it.

start: waits for the participant's button; pause: by the operator; example: a stimulus without a question;
rest: the answer is noted, and the next stimulus comes; stopped: the program ends before the last trial
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


class SeenMessage(Section):
    """A page has received the view with this number."""

    kind: Literal["seen"]
    view: Index


class OperatorMessage(Section):
    """A command of the operator: no further stimulus, go on, or stop the display and end the session's run."""

    kind: Literal["pause", "resume", "stop"]


ParticipantMessage = AnswerMessage | AgainMessage | ReadyMessage | SeenMessage
PARTICIPANT_MESSAGES: TypeAdapter[ParticipantMessage] = TypeAdapter(
    Annotated[ParticipantMessage, Field(discriminator="kind")]
)
OPERATOR_MESSAGES: TypeAdapter[OperatorMessage] = TypeAdapter(OperatorMessage)


class ParticipantView(JsonModel):
    """All that the participant's page shows. It never holds a condition.

    trial: number of the present or next trial, from 1; trials: number of all
    example: number of the example and of all; announced: the presentation that answers are about
    is_early: there was an answer before the stimulus had ended; answered: the answer that was noted last
    is_begun: the participant was ready before
    """

    phase: Phase
    title: str
    question: str
    kind: Literal["choice", "magnitude"]
    answers: tuple[str, ...]
    trial: int
    trials: int
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
    condition: dict[str, Value]
    answer: str | float
    is_correct: bool | None
    response_time_s: float
    response_latency_s: float | None
    early_answers: int | None
    pulses: int
    duration_s: float


class Executed(JsonModel):
    """A presentation as the board reports it. fault: how it differs from the request."""

    pulses: int
    duration_s: float
    onset_s: float
    fault: str | None


class OperatorView(JsonModel):
    """All that the operator's page shows.

    answered: number of trials that count; rows: the newest of them, in order; notice: of the program, one line
    """

    phase: Phase
    title: str
    participant: str
    pattern: str
    parameters: dict[str, Value]
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
