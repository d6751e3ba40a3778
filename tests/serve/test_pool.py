"""The workers serve clients in turn and refuse what would be late."""

import asyncio
import time

import pytest

from slimsfm.serve.errors import ApiError
from slimsfm.serve.pool import FairPool


@pytest.fixture
def pool():
    made = FairPool(1, 20)
    yield made
    made.close()


def test_clients_take_turns(pool):
    done = []

    async def run():
        first = asyncio.ensure_future(pool.run("x", "k", lambda: time.sleep(0.1)))
        await asyncio.sleep(0.02)
        many = [pool.run("much", "k", lambda n=n: done.append(("much", n)), 60) for n in range(6)]
        few = [pool.run("few", "k", lambda n=n: done.append(("few", n)), 60) for n in range(2)]
        await asyncio.gather(first, *many, *few)

    asyncio.run(run())
    assert [name for name, _ in done] == ["much", "few", "much", "few", "much", "much", "much", "much"]
    assert [n for name, n in done if name == "much"] == list(range(6))


def test_what_would_be_late_is_refused_before_it_waits(pool):
    async def run():
        slow = asyncio.ensure_future(pool.run("x", "slow", lambda: time.sleep(0.3)))
        await slow  # now it is known how long it takes
        waiting = [
            asyncio.ensure_future(pool.run("x", "slow", lambda: time.sleep(0.1), 60)) for _ in range(8)
        ]
        await asyncio.sleep(0.02)
        start = time.perf_counter()
        with pytest.raises(ApiError, match="try again later") as raised:
            await pool.run("x", "slow", lambda: None, 0.2)
        assert time.perf_counter() - start < 0.1
        assert (raised.value.status, raised.value.retry_after_s >= 1) == (503, True)
        await pool.run("other", "quick", lambda: None, 0.5)  # whose line is empty
        await asyncio.gather(*waiting)

    asyncio.run(run())


def test_what_became_late_is_not_begun(pool):
    begun = []

    async def run():
        blocking = asyncio.ensure_future(pool.run("x", "quick", lambda: time.sleep(0.4)))
        await asyncio.sleep(0.02)
        with pytest.raises(ApiError) as raised:
            await pool.run("x", "quick", lambda: begun.append(1), 0.2)
        assert raised.value.status == 504
        await blocking

    asyncio.run(run())
    assert begun == []


def test_what_nobody_waits_for_is_not_begun(pool):
    begun = []

    async def run():
        blocking = asyncio.ensure_future(pool.run("x", "k", lambda: time.sleep(0.2)))
        await asyncio.sleep(0.02)
        left = asyncio.ensure_future(pool.run("x", "k", lambda: begun.append(1), 60))
        await asyncio.sleep(0.02)
        left.cancel()
        await blocking
        await pool.run("x", "k", lambda: None)

    asyncio.run(run())
    assert begun == []


def test_errors_of_work_are_raised_and_the_thread_lives_on(pool):
    async def run():
        with pytest.raises(ZeroDivisionError):
            await pool.run("x", "k", lambda: 1 // 0)
        return await pool.run("x", "k", lambda: 5)

    assert asyncio.run(run()) == 5


def test_the_line_is_bounded_but_for_who_sends_one_at_a_time(pool):
    async def run():
        blocking = asyncio.ensure_future(pool.run("x", "k", lambda: time.sleep(0.2)))
        await asyncio.sleep(0.02)
        waiting = [asyncio.ensure_future(pool.run("x", "k", lambda: None, 60)) for _ in range(20)]
        await asyncio.sleep(0.02)
        with pytest.raises(ApiError):
            await pool.run("y", "k", lambda: None, 60)
        assert await pool.run("y", "k", lambda: 5) == 5
        await asyncio.gather(blocking, *waiting)

    asyncio.run(run())


def test_a_closed_pool_finishes_what_it_has():
    pool, done = FairPool(1, 20), []

    async def run():
        waiting = [asyncio.ensure_future(pool.run("x", "k", lambda n=n: done.append(n))) for n in range(5)]
        await asyncio.sleep(0)
        await asyncio.to_thread(pool.close)
        await asyncio.gather(*waiting)
        with pytest.raises(ApiError):
            await pool.run("x", "k", lambda: None)

    asyncio.run(run())
    assert done == list(range(5))
