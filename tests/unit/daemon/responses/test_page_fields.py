"""The page's field names against the models: a renamed member fails here, not in a browser."""

import re
from dataclasses import fields as dataclass_fields
from dataclasses import is_dataclass
from pathlib import Path
from types import UnionType
from typing import Union, get_args, get_origin, get_type_hints

import pytest
from pydantic import BaseModel

import optodrive.daemon
from optodrive.daemon.responses.messages import HoldReport
from optodrive.daemon.responses.plan import PatternList, PlanReport
from optodrive.daemon.responses.problem import Problem
from optodrive.daemon.responses.state import (
    CallerReport,
    ControlReport,
    PulseTotals,
    QueuedPlan,
    QueueReport,
    RecentPlan,
    StateReport,
)
from optodrive.daemon.responses.telemetry import (
    BudgetEvent,
    CapUsage,
    DisplayEvent,
    FaultEvent,
    FingersEvent,
    PageEvent,
    PulseBatch,
    PulsesEvent,
    TouchedFinger,
)
from optodrive.planning.effective_config import EffectiveConfig
from optodrive.planning.stimuli.pattern import PatternDescription, PatternParameter
from optodrive.planning.summary_schema import DelaySummary, OffTargetTrain, PlanSummary, PulseColumns

PAGE = Path(optodrive.daemon.__file__).parent / "page"
VARIABLES = {
    "api.js": {"problem": Problem},
    "fingers.js": {"finger": TouchedFinger},
    "gauges.js": {"cap": CapUsage},
    "grid.js": {"config": EffectiveConfig, "display": EffectiveConfig.model_fields["display"].annotation},
    "history.js": {"fault": FaultEvent, "plan": RecentPlan, "queue": QueueReport, "totals": PulseTotals},
    "main.js": {"config": EffectiveConfig, "pulses": PulseColumns},
    "patterns.js": {"pattern": PatternDescription, "parameter": PatternParameter},
    "permissions.js": {"caller": CallerReport},
    "plans.js": {"plan": PlanReport, "summary": PlanSummary, "delay": DelaySummary, "train": OffTargetTrain},
    "queue.js": {"plan": QueuedPlan, "queue": QueueReport},
    "dim.js": {"state": StateReport},
    "hold.js": {"report": HoldReport},
    "pause.js": {"queue": QueueReport},
    "header.js": {"queue": QueueReport, "board": StateReport.model_fields["board"].annotation},
    "status.js": {"fault": FaultEvent, "board": StateReport.model_fields["board"].annotation},
    "timeline.js": {"batch": PulseBatch},
}
"""The models that the page's variables hold, by module."""
EVENT_DETAILS = {"state": StateReport, "fault": FaultEvent, "budget": BudgetEvent, "display": DisplayEvent}
DESTRUCTURED = {
    ("main.js", r"const \[config, \{([^}]*)\}\]"): PatternList,
    ("arm.js", r"const \{([^}]*)\} = control;"): ControlReport,
    ("fingers.js", r"showFingers\(\{([^}]*)\}\)"): FingersEvent,
    ("fingers.js", r"showPage\(\{([^}]*)\}\)"): PageEvent,
    ("header.js", r"showState\(\{([^}]*)\}\)"): StateReport,
    ("pause.js", r"const \{([^}]*)\} = await call"): StateReport,
    ("permissions.js", r"const \{([^}]*)\} = this.caller;"): CallerReport,
    ("plans.js", r"const \{([^}]*)\} = plan;"): PlanReport,
    ("status.js", r"const \{([^}]*)\} = state;"): StateReport,
    ("timeline.js", r"addPulses\(\{([^}]*)\}\)"): PulsesEvent,
}
OTHER_VARIABLES = {
    "status.js": {"link": "link", "totals": "totals"},
}


def list_members(kind):
    """The members of a model or dataclass with their types, None for any other type."""
    for item in get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,):
        if isinstance(item, type) and issubclass(item, BaseModel):
            return {name: field.annotation for name, field in item.model_fields.items()}
        if is_dataclass(item):
            hints = get_type_hints(item)
            return {field.name: hints[field.name] for field in dataclass_fields(item)}
    return None


def check_chain(kind, names, place):
    """Follow member names through models until a value that is none."""
    for name in names:
        members = list_members(kind)
        if members is None:
            return
        assert name in members, f"{place}: no member {name!r} of {kind}"
        kind = members[name]


def find_chains(text, variable):
    for match in re.finditer(rf"(?<![\w.#\"'/-]){variable}((?:\??\.\w+)+)", text):
        yield match.group(0), [name for name in re.split(r"\??\.", match.group(1)) if name]


@pytest.mark.parametrize(
    ("module", "variable", "model"),
    [(module, variable, model) for module, models in VARIABLES.items() for variable, model in models.items()],
)
def test_every_member_that_the_page_reads_exists(module, variable, model):
    text = (PAGE / module).read_text(encoding="utf-8")
    chains = list(find_chains(text, variable))
    assert chains
    for place, names in chains:
        check_chain(model, names, f"{module}: {place}")


def test_members_read_from_parts_of_the_state_exist():
    for module, variables in OTHER_VARIABLES.items():
        text = (PAGE / module).read_text(encoding="utf-8")
        for variable, member in variables.items():
            chains = list(find_chains(text, variable))
            assert chains
            for place, names in chains:
                check_chain(StateReport, [member, *names], f"{module}: {place}")


@pytest.mark.parametrize(("place", "model"), DESTRUCTURED.items())
def test_every_member_that_the_page_destructures_exists(place, model):
    module, pattern = place
    (found,) = re.findall(pattern, (PAGE / module).read_text(encoding="utf-8"))
    names = [name.strip() for name in found.split(",")]
    assert names
    assert set(names) <= set(model.model_fields)


@pytest.mark.parametrize(("event", "model"), EVENT_DETAILS.items())
def test_every_member_of_an_event_that_the_page_reads_exists(event, model):
    text = (PAGE / "main.js").read_text(encoding="utf-8")
    (handler,) = re.findall(rf'addEventListener\("{event}", (.*?)\n?\}}?\);\n', text, flags=re.DOTALL)
    for place, names in find_chains(handler, "detail"):
        check_chain(model, names, f"main.js: {event}: {place}")


def test_a_renamed_member_is_caught():
    with pytest.raises(AssertionError, match="no member 'asked_max_um'"):
        check_chain(PlanSummary, ["asked_max_um", "toFixed"], "here")
    with pytest.raises(AssertionError, match="no member 'sentence'"):
        check_chain(PlanReport, ["summary", "feasibility", "sentence"], "here")
