import threading

import pytest

from anytouch_jax.data.loading.threads import BatchJobs, bounded_map, prefetch_batches, run_jobs


def _ours():
    return [thread for thread in threading.enumerate() if thread.name.startswith("anytouch-data")]


def _plan(step, log=None):
    batch = [None] * 10

    def job(slot):
        batch[slot] = (step, slot)
        return slot % 2

    if log is not None:
        log.append(step)
    return BatchJobs(batch, [lambda slot=slot: job(slot) for slot in range(10)], {"n": step})


@pytest.mark.parametrize("threads", [0, 1, 2, 4])
@pytest.mark.parametrize("prefetch", [0, 1, 3])
def test_batches_come_whole_and_in_order(threads, prefetch):
    got = list(prefetch_batches(_plan, range(3, 9), threads, prefetch))
    assert [step for step, _, _ in got] == list(range(3, 9))
    for step, batch, info in got:
        assert batch == [(step, slot) for slot in range(10)] and info == {
            "skipped_samples": 5,
            "n": step,
        }
    assert not _ours()
    assert run_jobs(_plan(4)) == (got[1][1], got[1][2])
    assert list(prefetch_batches(_plan, range(0), threads, prefetch)) == []


def test_no_more_is_planned_than_the_prefetch():
    log = []
    stream = prefetch_batches(lambda step: _plan(step, log), range(100), 2, 3)
    assert log == []  # nothing before the first batch is asked for
    for taken in range(1, 6):
        next(stream)
        assert log == list(range(taken + 3))
    stream.close()
    assert not _ours()


def test_closing_early_ends_the_threads_and_drops_what_waits():
    done = []
    gate = threading.Event()

    def plan(step):
        def job():
            if step:
                gate.wait(10)
                done.append(step)
            return 0

        return BatchJobs(step, [job] * 4)

    stream = prefetch_batches(plan, range(50), 2, 20)
    assert next(stream)[0] == 0
    assert len(_ours()) == 2
    threading.Timer(0.05, gate.set).start()
    stream.close()
    assert not _ours()
    assert len(done) <= 2 * 4  # only what had begun


@pytest.mark.parametrize("threads", [0, 1, 3])
def test_the_first_error_of_a_step_reaches_the_caller(threads):
    def plan(step):
        def job(slot):
            if step == 2 and slot >= 5:
                raise ValueError(f"slot {slot}")
            return 0

        return BatchJobs(step, [lambda slot=slot: job(slot) for slot in range(9)])

    drawn = []
    with pytest.raises(ValueError, match="slot 5"):
        for step, _, _ in prefetch_batches(plan, range(9), threads, 4):
            drawn.append(step)
    assert drawn == [0, 1] and not _ours()


def test_an_error_in_the_caller_or_in_the_plan_ends_the_threads():
    def plan(step):
        if step == 3:
            raise ValueError("no plan")
        return _plan(step)

    with pytest.raises(RuntimeError, match="mine"):
        for _ in prefetch_batches(_plan, range(9), 2, 2):
            raise RuntimeError("mine")
    assert not _ours()
    with pytest.raises(ValueError, match="no plan"):
        list(prefetch_batches(plan, range(9), 2, 2))
    assert not _ours()


@pytest.mark.parametrize("threads", [0, 1, 4])
def test_a_bounded_map_keeps_order_and_stays_close(threads):
    taken = []

    def items():
        for i in range(50):
            taken.append(i)
            yield i

    done = 0
    for i, result in enumerate(bounded_map(lambda x: x * x, items(), threads, 6)):
        assert result == i * i and len(taken) <= i + 6 + 1
        done += 1
    assert done == 50


def test_a_bounded_map_raises_the_first_error_and_ends_its_threads():
    before = threading.active_count()
    results = bounded_map(lambda x: 1 // (x - 3), range(100), 3)
    assert [next(results) for _ in range(3)] == [-1, -1, -1]
    with pytest.raises(ZeroDivisionError):
        next(results)
    early = bounded_map(str, range(100), 3)
    next(early)
    early.close()
    assert threading.active_count() == before
