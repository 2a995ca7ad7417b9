"""A plant and its controller stay on one processor while their ticks are short; other rigs are not placed."""

import os
import threading
from contextlib import suppress

import pytest
from conftest import make_scenario
from simulated import SimulatedRig, World
from softrig_core import rig_of
from softrig_nodes.ros.processor import ENOUGH, LONG, SHORT, Processor

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="Linux")


def motor(executable, **entry):
    return {"package": "softrig_drives", "executable": executable, "parameters": {"period": 0.001}, **entry}


SOURCE = {"package": "softrig_control", "executable": "reference_source", "remap": {"reference": "motor/reference"}}
PAIR = {"plant": motor("dc_motor_plant"), "law": motor("dc_motor_smc")}


@pytest.fixture
def allowed():
    """The processors of this process, restored afterwards."""
    before = os.sched_getaffinity(0)
    if len(before) < 2:
        pytest.skip("one processor")
    yield sorted(before)
    for thread in os.listdir("/proc/self/task"):
        with suppress(ProcessLookupError):  # threads of other tests may end in the meantime
            os.sched_setaffinity(int(thread), before)


class Work:
    """The work that a process has done so far."""

    messages = time = 0

    def more(self, messages, each):
        self.messages += messages
        self.time += messages * each


def placed(domain=0, beside=False):
    work = Work()
    return work, Processor(domain, beside, lambda: work.messages, lambda: work.time)


def test_nodes_of_a_domain_share_one_and_the_next_domain_has_another(allowed):
    numbers = []
    for domain in range(len(allowed) + 1):
        _, processor = placed(domain)
        numbers.append(processor.number)
        assert os.sched_getaffinity(0) == {processor.number}
        processor._go(allowed)
    assert numbers == [*allowed, allowed[0]]


def test_every_thread_stays_until_messages_take_long_and_returns(allowed):
    over, seen = threading.Event(), {}
    thread = threading.Thread(target=over.wait)
    thread.start()

    def where():
        return {frozenset(os.sched_getaffinity(t)) for t in (0, thread.native_id)}

    work, processor = placed(1)
    own, everywhere = {frozenset({allowed[1 % len(allowed)]})}, {frozenset(allowed)}
    work.time += 100 * SHORT  # time used before the first message
    processor.step()
    work.more(1, 50 * SHORT)  # the first samples include the start and are not judged
    processor.step()
    seen["start"] = where()
    work.more(100, SHORT // 2)
    processor.step()
    seen["short"] = where()
    work.more(3, 2 * SHORT)
    processor.step()  # too few samples to decide
    seen["few"] = where()
    work.more(1, LONG)
    processor.step()
    seen["long"] = where()
    work.time += 2 * LONG
    processor.step()  # a held rig is not measured
    seen["held"] = where()
    work.more(10 * ENOUGH, SHORT // 2)
    processor.step()  # these samples include work while the rig was held
    seen["after"] = where()
    work.more(ENOUGH, SHORT // 2)
    processor.step()
    seen["short again"] = where()
    over.set()
    thread.join()
    stays, goes = ("start", "short", "few", "short again"), ("long", "held", "after")
    assert seen == dict.fromkeys(stays, own) | dict.fromkeys(goes, everywhere)


def test_a_follower_runs_beside_them_until_messages_take_long(allowed):
    work, processor = placed(1, beside=True)
    others = set(allowed) - {allowed[1 % len(allowed)]}
    assert os.sched_getaffinity(0) == others
    assert processor.number == (min(others) if len(others) == 1 else None)
    for each, where in ((1, others), (SHORT // 2, others), (2 * SHORT, set(allowed))):
        work.more(ENOUGH, each)
        processor.step()
        assert os.sched_getaffinity(0) == where
    assert processor.number is None


@pytest.mark.parametrize(
    ("messages", "each", "stays"),
    [
        (ENOUGH, SHORT - 1, True),
        (ENOUGH, SHORT, False),
        (ENOUGH - 1, SHORT, True),
        (1, LONG, False),
        (1, LONG - 1, True),
    ],
)
def test_long_messages_and_the_number_needed_to_judge_are_as_expected(messages, each, stays, allowed):
    work, processor = placed()
    work.more(1, 0)
    processor.step()
    work.more(messages, each)
    processor.step()
    assert (processor.number is not None) is stays


@pytest.mark.parametrize("beside", [False, True])
def test_a_process_with_a_single_processor_is_left_alone(beside, allowed):
    os.sched_setaffinity(0, {allowed[-1]})
    _, processor = placed(len(allowed), beside)
    assert processor.number is None
    assert os.sched_getaffinity(0) == {allowed[-1]}


def other(number, **entry):
    """Another controller, whose command no node reads."""
    return {f"other_{number}": motor("dc_motor_smc", remap={"motor/command": f"other/command_{number}"}, **entry)}


@pytest.mark.parametrize(
    ("more", "places"),
    [
        ({}, ["together"] * 2),
        (other(1), ["together"] * 2 + ["beside"]),
        (other(1) | other(2), ["together"] * 2 + ["beside"] * 2),
        # Two followers exceed what the second processor can do during a tick of the plant.
        (other(1) | other(2) | other(3), ["anywhere"] * 5),
        ({"reference": SOURCE}, ["anywhere"] * 3),  # the source works at the same time as the plant
        (other(1, external=True), ["anywhere"] * 2),  # it is unknown what an external node subscribes to
    ],
)
def test_a_plant_and_its_controller_share_a_processor_and_followers_run_beside_them(more, places):
    run = SimulatedRig(rig_of(make_scenario(PAIR | more, 0.01)), World(), "lockstep")
    run.run(0.2)
    assert [node.place for node in run.nodes.values()] == places
