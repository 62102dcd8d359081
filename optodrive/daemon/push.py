"""A push on its way through the daemon, its body, and the sequence that is built from it."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple, Never

from optodrive.core.errors import InputError
from optodrive.core.types.push_options import PushOptions
from optodrive.core.types.stimuli import FrameSequence
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.stimuli.json_values import decode_json, parse_labels
from optodrive.planning.stimuli.pattern_registry import build_pattern, find_pattern
from optodrive.planning.stimuli.sequence_file import parse_request


class Push(NamedTuple):
    """The fields of a push besides its body. A message carries the mapping `_asdict()`.

    name: what the plan is called
    streamed: replace everything not yet sent; the next streamed plan replaces this one in the same way
    standing: draw the part of a streamed page whose turn it is; touched_only: of its dots under fingers
    refreshes: whether the page stands already, and nobody waits for the plan's report or its end
    arrived_s: monotonic time of its arrival; epoch: in which it arrived; caller: name of its token
    lists_pulses: whether the answer lists the pulses one by one
    """

    name: str
    options: PushOptions
    arrived_s: float
    epoch: int
    caller: str = ""
    streamed: bool = False
    lists_pulses: bool = True
    standing: bool = False
    touched_only: bool = False
    refreshes: bool = False


LabelValues = Mapping[str, str | int | float | bool]
ParameterValues = Mapping[str, str | float | bool | None]
NO_LABELS: Mapping[str, Never] = MappingProxyType({})


class BuiltRequest(NamedTuple):
    """Sequence of a body, labels of its caller, and all parameters of its pattern, in the units of their names."""

    sequence: FrameSequence
    labels: LabelValues = NO_LABELS
    parameters: ParameterValues = NO_LABELS


def build_request(display: DisplayModel, source: str, name: str, body: bytes) -> BuiltRequest:
    """Build the sequence of a body: of FRAMES.json, or of the parameters of the named pattern. Raise InputError."""
    if source == "sequence":
        return BuiltRequest(*parse_request(body, display.config, "body"))
    decoded = decode_json(body, "body") if body.strip() else {}
    if not isinstance(decoded, dict):
        raise InputError("body", decoded, "an object of the pattern's parameters")
    labels = parse_labels(decoded.pop("labels", {}), "body: labels")
    sequence = build_pattern(name, decoded, display.config)
    return BuiltRequest(sequence, labels, find_pattern(name).describe_arguments(decoded, display.config))
