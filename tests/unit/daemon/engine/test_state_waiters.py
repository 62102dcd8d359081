"""Uncancellable futures."""

import asyncio

from optodrive.daemon.engine.state_waiters import uncancellable_future


def test_a_cancelled_consumer_does_not_cancel_the_future():
    future = uncancellable_future()

    async def give_up():
        waiter = asyncio.create_task(asyncio.wait_for(asyncio.wrap_future(future), 10))
        await asyncio.sleep(0)
        waiter.cancel()
        await asyncio.gather(waiter, return_exceptions=True)

    asyncio.run(give_up())
    assert not future.cancelled()
    future.set_result("done")
    assert future.result() == "done"
