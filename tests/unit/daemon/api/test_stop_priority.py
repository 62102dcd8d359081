import asyncio
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from optodrive.core.json_model import JsonModel, iterate_json
from optodrive.daemon.api.request_limits import StopPriorityMiddleware


class Leaf(JsonModel):
    names: dict[str, int]
    values: list[float | None]


class Tree(JsonModel):
    text: str
    leaf: Leaf | None
    leaves: list[Leaf]


FINITE = st.floats(allow_nan=False, allow_infinity=False)
LEAVES = st.builds(
    Leaf, names=st.dictionaries(st.text(), st.integers(-9, 9)), values=st.lists(st.none() | FINITE, max_size=4)
)


@given(st.builds(Tree, text=st.text(), leaf=st.none() | LEAVES, leaves=st.lists(LEAVES, max_size=3)))
def test_pieces_make_the_same_json(model):
    assert json.loads(b"".join(iterate_json(model))) == model.model_dump(mode="json")


def test_nan_is_no_json():
    with pytest.raises(ValidationError, match="finite"):
        Leaf(names={}, values=[float("nan")])


def is_permitted(scope):
    return True


def collect_start_order(middleware, paths):
    """Return the order in which requests start that arrive at the same time in the given order."""
    order = []

    async def app(scope, receive, send):
        order.append(scope["path"])

    async def run():
        front = middleware(app)
        await asyncio.gather(*(front({"type": "http", "path": path}, None, None) for path in paths))

    asyncio.run(run())
    return order


def test_stop_starts_first_and_the_others_in_order():
    paths = [*(f"/v1/plans/{k}" for k in range(50)), "/v1/stop"]
    assert collect_start_order(lambda app: StopPriorityMiddleware(app, is_permitted), paths) == [
        "/v1/stop",
        *paths[:50],
    ]
    refused = collect_start_order(lambda app: StopPriorityMiddleware(app, lambda scope: False), paths)
    assert refused == paths  # a STOP without a token waits for its turn
    assert collect_start_order(lambda app: app, paths)[-1] == "/v1/stop"  # without the middleware


def test_a_slow_request_delays_no_other():
    async def run():
        done = asyncio.Event()

        async def app(scope, receive, send):
            if scope["path"] == "/v1/arm":
                await done.wait()
            else:
                done.set()

        front = StopPriorityMiddleware(app, is_permitted)
        scopes = [{"type": "http", "path": path} for path in ("/v1/arm", "/v1/state")]
        await asyncio.gather(*(front(scope, None, None) for scope in scopes))

    asyncio.run(run())


async def collect_order_during_stop(stop):
    """Return the order in which requests start and STOP ends, all of which arrive at the same time."""
    order = []

    async def app(scope, receive, send):
        if scope["path"] == "/v1/stop":
            await stop(order)
        order.append(scope["path"])

    front = StopPriorityMiddleware(app, is_permitted)
    paths = ["/v1/stop", *(f"/v1/plans/{k}" for k in range(20))]
    await asyncio.gather(*(front({"type": "http", "path": path}, None, None) for path in paths))
    return order


def test_no_request_starts_while_stop_is_being_answered():
    async def stop(order):
        for _ in range(100):
            await asyncio.sleep(0)

    assert asyncio.run(collect_order_during_stop(stop))[0] == "/v1/stop"


def test_an_unanswered_stop_delays_others_only_briefly():
    async def stop(order):
        while len(order) < 20:
            await asyncio.sleep(0.01)

    assert asyncio.run(collect_order_during_stop(stop))[-1] == "/v1/stop"
