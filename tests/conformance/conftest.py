"""Fixtures of board kinds; the scenarios of a module run concurrently."""

from functools import cache

import pytest

pytest.register_assert_rewrite(*(f"{name}_scenarios" for name in ("guard", "job", "link", "order", "self", "trust")))

from bench import BOARD_KINDS  # noqa: E402
from scenario import run_all  # noqa: E402


@pytest.fixture(scope="session")
def ready(tmp_path_factory):
    """Return a function that builds a kind's program, or a mutant of it, once for all threads."""
    boards = tmp_path_factory.mktemp("boards")

    @cache
    def build(name, mutant):
        (kind,) = [kind for kind in BOARD_KINDS if kind.name == name]
        return kind.ready(boards / f"{name}-{mutant}", mutant)

    return build


@pytest.fixture(scope="module", params=[kind.name for kind in BOARD_KINDS])
def board_kind(request, ready):
    return ready(request.param, 0)


@pytest.fixture(scope="module")
def outcomes(board_kind, request):
    """Return the futures of this module's selected scenarios, by name."""
    here = [item for item in request.session.items if item.module is request.module and hasattr(item, "callspec")]
    requested = {item.callspec.params["case"].name: item.callspec.params["case"] for item in here}
    futures = run_all(board_kind, [case for case in requested.values() if not board_kind.spares(case.subject)])
    yield futures
    for future in futures.values():
        future.cancel()


@pytest.fixture
def conforms(board_kind, outcomes):
    """Return a function that raises a scenario's error, or skips it for an exempted kind of board."""

    def look(case):
        if why := board_kind.spares(case.subject):
            pytest.skip(f"{board_kind.name}: {why}")
        outcomes[case.name].result()

    return look
