"""All scenarios, registered by their modules."""

import edge_scenarios
import guard_scenarios
import job_scenarios
import link_scenarios
import order_scenarios
import self_scenarios
import trigger_scenarios
import trust_scenarios
from scenario import SCENARIOS

__all__ = ["GUARD_MODULES", "MODULES", "SCENARIOS"]

GUARD_MODULES = [module.__name__ for module in (guard_scenarios, trust_scenarios, order_scenarios, self_scenarios)]
MODULES = [
    *GUARD_MODULES,
    job_scenarios.__name__,
    link_scenarios.__name__,
    edge_scenarios.__name__,
    trigger_scenarios.__name__,
]
