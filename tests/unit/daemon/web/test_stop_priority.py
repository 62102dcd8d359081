import asyncio
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from optodrive.daemon.web.stop_priority import StopPriorityMiddleware, build_json_response, iterate_json

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@given(st.dictionaries(st.text(), JSON, max_size=5))
def test_pieces_make_the_same_json(value):
    assert json.loads("".join(iterate_json(value))) == value


def test_nan_is_no_json():
    with pytest.raises(ValueError, match="not JSON compliant"):
        list(iterate_json({"a": [float("nan")]}))


def test_an_answer_has_its_status_and_its_type():
    response = asyncio.run(build_json_response({"µ": [1.5]}, 201))
    assert (response.status_code, response.body.decode()) == (201, '{"µ":[1.5]}')
    assert response.headers["content-type"] == "application/json"


def collect_start_order(middleware, paths):
    """In which order requests begin that arrived in this order at one time."""
    order = []

    async def app(scope, receive, send):
        order.append(scope["path"])

    async def run():
        front = middleware(app)
        await asyncio.gather(*(front({"type": "http", "path": path}, None, None) for path in paths))

    asyncio.run(run())
    return order


def test_stop_begins_before_all_that_wait_and_these_in_order():
    paths = [*(f"/v1/plans/{k}" for k in range(50)), "/v1/stop"]
    assert collect_start_order(StopPriorityMiddleware, paths) == ["/v1/stop", *paths[:50]]
    assert collect_start_order(lambda app: app, paths)[-1] == "/v1/stop"  # as it was without


def test_one_that_takes_long_holds_no_other_up():
    async def run():
        done = asyncio.Event()

        async def app(scope, receive, send):
            if scope["path"] == "/v1/arm":
                await done.wait()
            else:
                done.set()

        front = StopPriorityMiddleware(app)
        scopes = [{"type": "http", "path": path} for path in ("/v1/arm", "/v1/state")]
        await asyncio.wait_for(asyncio.gather(*(front(scope, None, None) for scope in scopes)), 5)

    asyncio.run(run())


async def collect_order_during_stop(stop):
    """In which order requests begin, and STOP ends, that arrived in this order at one time."""
    order = []

    async def app(scope, receive, send):
        if scope["path"] == "/v1/stop":
            await stop(order)
        order.append(scope["path"])

    front = StopPriorityMiddleware(app)
    paths = ["/v1/stop", *(f"/v1/plans/{k}" for k in range(20))]
    await asyncio.gather(*(front({"type": "http", "path": path}, None, None) for path in paths))
    return order


def test_none_begins_while_stop_is_answered():
    async def stop(order):
        for _ in range(100):
            await asyncio.sleep(0)

    assert asyncio.run(collect_order_during_stop(stop))[0] == "/v1/stop"


def test_a_stop_that_is_not_answered_holds_others_up_for_a_moment_only():
    async def stop(order):
        while len(order) < 20:
            await asyncio.sleep(0.01)

    assert asyncio.run(asyncio.wait_for(collect_order_during_stop(stop), 30))[-1] == "/v1/stop"
