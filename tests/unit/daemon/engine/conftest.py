import pytest

from planner_rig import PlannerRig


@pytest.fixture
def rig(monkeypatch):
    """Planner, queue and session in virtual time, with an armed board."""
    rig = PlannerRig(monkeypatch).ready()
    rig.arm()
    rig.run(0.01)
    return rig
