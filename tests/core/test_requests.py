"""Requests of services: in order of arrival, within a share of the time, answered only to clients that are there."""

from collections import deque
from types import SimpleNamespace

import pytest
from softrig_core.timebase import SECOND
from softrig_nodes.ros import requests
from softrig_nodes.ros.requests import Credit, Requests

MS = SECOND // 1000


class Clock:
    """The two clocks of a host, in ns."""

    def __init__(self):
        self.ns, self.offset = 100 * SECOND, 10**18

    def time_ns(self):
        return self.ns + self.offset

    def monotonic_ns(self):
        return self.ns

    def monotonic(self):
        return self.ns / SECOND


class World:
    """A node whose services have queues; a request has an arrival, a client and a content."""

    def __init__(self, monkeypatch, cost=0):
        self.clock, self.queues, self.clients, self.log = Clock(), {}, {b"a"}, []
        self.paused, self.dropped, self.cost, self.look_cost = False, 0, cost, 0
        monkeypatch.setattr(requests, "time", self.clock)
        monkeypatch.setattr(requests, "leave_requests_to_us", lambda node, service: None)
        monkeypatch.setattr(requests, "next_request", self.take)
        monkeypatch.setattr(requests, "client_of", lambda header: header.client)
        monkeypatch.setattr(requests, "answer_readers", lambda node, service: self.clients)
        self.requests = Requests(None, Credit(), lambda: self.paused, self.drop)

    def drop(self):
        self.dropped += 1

    def take(self, service):
        self.clock.ns += self.look_cost
        return self.queues[service.name].popleft() if self.queues[service.name] else (None, None)

    def offer(self, *names):
        for name in names:
            self.queues[name] = deque(maxlen=100)
            service = SimpleNamespace(name=name, srv_type=SimpleNamespace(Response=dict))
            service.send_response = lambda response, header: self.log.append((response["name"], header.client))
            self.requests.add(service, self.answering(name))

    def answering(self, name):
        def answer(request, response, wait):
            self.clock.ns += self.cost
            return {"name": name if not wait else f"{name} refused for {wait:g} s"}

        return answer

    def ask(self, name, client=b"a"):
        self.clock.ns += 1000
        self.queues[name].append((name, SimpleNamespace(received_timestamp=self.clock.time_ns(), client=client)))


def test_requests_of_all_services_are_answered_in_order_of_arrival(monkeypatch):
    world = World(monkeypatch)
    world.offer("pause", "resume", "step")
    order = ["pause", "step", "resume", "pause", "pause", "resume", "step"]
    for name in order:
        world.ask(name)
    assert world.requests.serve()
    assert [name for name, _ in world.log] == order
    world.clock.ns += SECOND
    assert not world.requests.serve()  # there was no call for a while


def test_a_resume_after_more_pauses_than_a_queue_holds_is_the_last(monkeypatch):
    world = World(monkeypatch)
    world.offer("resume", "pause")
    for _ in range(300):
        world.ask("pause", client=b"gone")
    world.ask("resume")
    world.requests.serve()
    assert world.log == [("resume", b"a")]
    assert world.requests._replies[0].header.client == b"gone"
    assert len(world.requests._replies) == 100


def test_a_request_that_arrives_during_a_check_waits_for_the_next_check(monkeypatch):
    """One of another service may have arrived before it, unseen."""
    world = World(monkeypatch)
    world.offer("a", "b")
    take = world.take

    def late(service):
        if service.name == "b" and not world.queues["b"] and not world.log:
            world.ask("a")
            world.ask("b")
        return take(service)

    monkeypatch.setattr(requests, "next_request", late)
    world.requests.serve()
    assert world.log == []
    world.requests.serve()
    assert [name for name, _ in world.log] == ["a", "b"]


def test_requests_that_arrived_before_the_clock_was_set_back_are_answered(monkeypatch):
    world = World(monkeypatch)
    world.offer("a")
    world.ask("a")
    world.clock.offset -= 3600 * SECOND
    world.requests.serve()
    assert world.log == []  # the request may have arrived during the check
    world.requests.serve()
    assert world.log == [("a", b"a")]


def test_services_get_a_fifth_of_the_time_and_a_waiting_set_is_refused(monkeypatch):
    world = World(monkeypatch, cost=100 * MS)
    world.offer("set")
    for _ in range(100):
        world.ask("set")
    for _ in range(1000):  # 10 s in steps of 10 ms
        world.clock.ns += 10 * MS
        world.requests.serve()
        world.queues["set"].clear()
        world.ask("set")
    answered = [name for name, _ in world.log]
    good = answered.count("set")
    assert 2.0 + 0.2 * 10.0 <= good * 0.1 <= 2.0 + 0.2 * (10.0 + len(answered) * 0.1) + 0.3
    for _ in range(50):
        world.ask("set")
    world.requests._credit.left, world.cost = -2.0, 0
    world.log.clear()
    world.clock.ns += 1 * SECOND
    world.requests.serve()
    assert world.log == []
    world.clock.ns += 2 * SECOND
    world.requests.serve()
    assert len(world.log) >= 50
    assert all(name.startswith("set refused for ") for name, _ in world.log)
    world.paused = True  # a paused rig has no ticks for which a call would have to wait
    world.ask("set")
    world.requests.serve()
    assert world.log[-1] == ("set", b"a")


def test_a_check_that_waits_for_the_lock_of_a_reader_counts_as_well(monkeypatch):
    world = World(monkeypatch)
    world.offer("list")
    world.look_cost = 700 * MS
    looks = []
    monkeypatch.setattr(requests, "next_request", lambda service: looks.append(0) or world.take(service))
    for _ in range(10):
        world.clock.ns += 20 * MS
        world.requests.serve()
    assert 3 <= len(looks) <= 4  # checks of 0.7 s each stop after about 2 s


def test_an_answer_waits_for_its_client_and_is_dropped_if_it_has_left(monkeypatch):
    world = World(monkeypatch)
    world.offer("list")
    world.ask("list", client=b"new")
    world.ask("list", client=b"gone")
    world.requests.serve()
    assert (world.log, world.dropped) == ([], 0)
    world.clients = {b"a", b"new"}
    world.clock.ns += 60 * MS
    world.requests.serve()
    assert (world.log, world.dropped) == ([("list", b"new")], 0)
    world.clock.ns += 2 * SECOND
    world.requests.serve()
    assert (len(world.log), world.dropped) == (1, 1)
    for _ in range(3):
        for _ in range(100):
            world.ask("list", client=b"gone")
        world.requests.serve()
    assert (len(world.log), world.dropped) == (1, 101)  # at most two hundred calls wait
    world.ask("list", client=b"")  # another version of rclpy may not report the client
    world.requests.serve()
    assert world.log[1:] == [("list", b"")]


def test_sets_take_a_fifth_of_the_time_and_two_seconds_in_a_row(monkeypatch):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(requests, "time", SimpleNamespace(monotonic=lambda: clock.now))
    credit = Credit()
    assert (credit.left, credit.wanting()) == (2.0, 0.0)
    with credit.spent():
        clock.now += 2.5
    assert credit.left == -0.5
    assert credit.wanting() == 2.5
    clock.now += 2.0
    assert credit.wanting() == pytest.approx(0.5)
    clock.now += 0.5
    assert credit.wanting() == pytest.approx(0.0)
    with credit.spent():
        clock.now += 100.0
    assert (credit.left, credit.wanting()) == (-2.0, 10.0)
    clock.now += 1000.0
    assert (credit.wanting(), credit.left) == (0.0, 2.0)
