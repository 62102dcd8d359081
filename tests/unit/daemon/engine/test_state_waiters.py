"""A caller that gives up does not stop whoever keeps the word."""

import asyncio

from optodrive.daemon.engine.state_waiters import uncancellable_future


def test_a_waiter_that_is_cancelled_leaves_the_promise_as_it_is():
    kept = uncancellable_future()

    async def give_up():
        waiter = asyncio.create_task(asyncio.wait_for(asyncio.wrap_future(kept), 10))
        await asyncio.sleep(0)
        waiter.cancel()
        await asyncio.gather(waiter, return_exceptions=True)

    asyncio.run(give_up())
    assert not kept.cancelled()
    kept.set_result("done")
    assert kept.result() == "done"
