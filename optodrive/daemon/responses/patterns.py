"""The response of GET /v1/patterns."""

from optodrive.core.json_model import JsonModel
from optodrive.planning.stimuli.pattern import PatternDescription


class PatternList(JsonModel):
    """The named patterns and their parameters.

    patterns: in the order in which `optodrive patterns` lists them
    """

    patterns: list[PatternDescription]
