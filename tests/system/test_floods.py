"""No flood of a caller without an arming token darkens a running show or keeps STOP from its effect.

The figures themselves come from `scripts/bench stop`. The bounds here hold on a busy computer too: STOP_MAX_S is ten
times the aim under a flood, and far below the seconds of a daemon in which a caller's work delays STOP.
"""

import pytest

from floods import FLOODS
from stop_rig import FLOOD_LEASE_S, StopRig

STOP_MAX_S = 0.5
STOPS = 3
WATCH_S = 2.5
EVERY_RUN = (
    ("duplicate keys to patterns", "http"),
    ("idle connections", "http"),
    ("connection churn", "http"),
    ("pings", "http"),
    ("valid previews", "http"),
)
"""The floods whose kind once darkened a show, kept one from beginning, or delayed STOP by seconds."""


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    rig = StopRig(tmp_path_factory.mktemp("floods"), FLOOD_LEASE_S)
    yield rig
    rig.close()


@pytest.mark.parametrize(
    ("name", "path"),
    [
        (name, path) if (name, path) in EVERY_RUN else pytest.param(name, path, marks=pytest.mark.slow)
        for name in FLOODS
        for path in ("http", "socket")
    ],
)
def test_a_show_goes_on_and_STOP_takes_effect(rig, name, path):
    result = rig.run_flood(name, STOPS, watch_s=WATCH_S if name != "callers" and path == "http" else 0.0, path=path)
    assert result.counts or name.startswith("slow"), "the flood reached nothing"
    assert not result.darkened
    assert not result.relit
    assert not result.not_begun, "the flood kept an armer from arming or pushing"
    assert result.gate_off_s, "no show was stopped under the flood"
    assert max(result.gate_off_s) <= STOP_MAX_S
    assert max(result.answered_s) <= STOP_MAX_S
