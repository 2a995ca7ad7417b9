"""A node does one thing at a time, whatever thread calls it; no message that has arrived is lost."""

import queue
import sys
import threading
from itertools import cycle

import pytest
from softrig_nodes.seam.monitor import LONG, SHORT_ONES, Monitor


class Executor:
    """Runs a monitor in this thread, when woken."""

    def __init__(self, clock=lambda: 0):
        self.woken = queue.SimpleQueue()
        self.monitor = Monitor(lambda: self.woken.put(None), clock)

    def turn(self, until):
        while not until():
            self.woken.get(timeout=10)
            self.monitor.serve()

    def warm(self):
        for _ in range(SHORT_ONES):
            self.monitor.arrive(lambda: None)
        self.monitor.serve()
        return self


def elsewhere(call):
    thread = threading.Thread(target=call)
    thread.start()
    thread.join(10)
    assert not thread.is_alive()


def test_short_work_is_done_in_the_receiving_thread_and_long_work_by_the_executor():
    where, times = [], [0]
    executor = Executor(lambda: times[0])

    def work(takes):
        where.append(threading.get_ident())
        times[0] += takes

    def arrive(takes):
        elsewhere(lambda: executor.monitor.arrive(lambda: work(takes)))

    this_thread = threading.get_ident()
    for k in range(SHORT_ONES):
        arrive(1000)
        assert len(where) == k  # the monitor only runs a call in this thread once it has measured enough calls
        executor.turn(lambda n=k: len(where) > n)
    assert set(where) == {this_thread}
    arrive(LONG)
    assert where.pop() != this_thread
    arrive(0)
    executor.turn(lambda: len(where) > SHORT_ONES)
    assert set(where) == {this_thread}
    assert executor.monitor.done == SHORT_ONES + 2


@pytest.mark.parametrize("warm", [False, True])
def test_messages_that_arrive_during_work_are_processed_after_it(warm):
    executor = Executor()
    monitor = executor.warm().monitor if warm else executor.monitor
    seen = []

    def outer():
        seen.append("in")
        monitor.arrive(lambda: seen.append("inner"))
        elsewhere(lambda: monitor.arrive(lambda: seen.append("other")))
        seen.append("out")

    monitor.arrive(outer)
    executor.turn(lambda: len(seen) == 4)
    assert seen == ["in", "out", "inner", "other"]
    with monitor:
        elsewhere(lambda: monitor.arrive(lambda: seen.append("then")))
        seen.append("first")
    assert seen[4:] == ["first", "then"]


class LateLock:
    """A lock before whose first release another message arrives, as in another thread."""

    def __init__(self, late):
        self._lock, self._late = threading.Lock(), [late]
        self.acquire = self._lock.acquire

    def release(self):
        while self._late:
            elsewhere(self._late.pop())
        self._lock.release()


@pytest.mark.parametrize("by_executor", [False, True])
def test_a_message_that_arrives_just_before_the_end_is_processed(by_executor):
    executor = Executor().warm()
    while not executor.woken.empty():
        executor.woken.get()
    monitor, seen = executor.monitor, []
    monitor._lock = LateLock(lambda: monitor.arrive(lambda: seen.append(1)))
    if by_executor:
        monitor.serve()
        executor.turn(lambda: seen)
    else:
        monitor.arrive(lambda: None)
    assert seen == [1]


@pytest.fixture
def restless():
    """Threads that switch as often as Python allows."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.parametrize("pattern", [(0,), (0, LONG), (0,) * 70 + (LONG,)])
def test_threads_never_meet_and_nothing_is_lost(pattern, restless):
    """Four threads and the executor's; the clock makes them change between the two ways."""
    takes = cycle(pattern)
    now = [0]

    def clock():
        now[0] += next(takes)
        return now[0]

    executor = Executor(clock)
    monitor, busy, done, seen = executor.monitor, threading.Lock(), [], {k: [] for k in range(5)}

    def work(thread, number):
        assert busy.acquire(blocking=False)
        seen[thread].append(number)
        busy.release()

    def bring(thread):
        for k in range(1000):
            monitor.arrive(lambda k=k: work(thread, k))
        done.append(thread)

    threads = [threading.Thread(target=bring, args=(thread_number,)) for thread_number in range(4)]
    for thread in threads:
        thread.start()
    for k in range(1000):
        with monitor:
            work(4, k)
        monitor.serve()
    for thread in threads:
        thread.join(10)
    assert sorted(done) == [0, 1, 2, 3]
    executor.turn(lambda: all(len(s) == 1000 for s in seen.values()))
    assert all(s == sorted(s) for s in seen.values())


def test_an_error_in_another_thread_is_raised_in_the_executor():
    executor = Executor().warm()
    seen = []

    def fail():
        raise ValueError("no")

    elsewhere(lambda: executor.monitor.arrive(fail))
    executor.monitor.arrive(lambda: seen.append(1))
    with pytest.raises(ValueError, match="no"):
        executor.turn(lambda: False)
    executor.monitor.serve()
    assert not seen  # a failed node processes no more messages


def test_after_an_error_of_the_executor_nothing_is_processed():
    monitor, seen = Executor().warm().monitor, []

    def fail():
        with monitor:
            monitor.arrive(lambda: seen.append(1))
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fail()
    monitor.arrive(lambda: seen.append(2))
    assert not seen
    assert monitor.closed


def test_the_end_waits_for_current_work_but_not_forever():
    executor = Executor().warm()
    monitor, begun, free = executor.monitor, threading.Event(), threading.Event()
    thread = threading.Thread(target=lambda: monitor.arrive(lambda: (begun.set(), free.wait(10))))
    thread.start()
    assert begun.wait(10)
    assert not monitor.close(0.01)
    free.set()
    assert monitor.close(10)
    thread.join(10)
    seen = []
    monitor.arrive(lambda: seen.append(1))
    monitor.serve()
    assert not seen
