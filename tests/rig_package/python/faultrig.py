"""Blocks for tests: a first-order plant, a proportional controller, and their ill-behaved relatives."""

import ctypes
import os
import signal
import sys
import time
from typing import ClassVar, NamedTuple

from softrig_core import (
    Block,
    BlockParams,
    Jobs,
    Observer,
    Plant,
    Sample,
    Solver,
    SolverParams,
    array,
    button,
    command,
    joint_state,
    number,
    param,
    reference,
    scalars,
)

STATE = joint_state("state", "lag/state", ["x"], position="m", velocity="m/s")
COMMAND = command("command", "lag/command", ["u"], "N")
REFERENCE = reference("reference", "lag/reference", ["x"], position="m")


class LagParams(BlockParams):
    gain: float = param(1.0, "gain", "1/s", gt=0.0, le=100.0)
    limit: float = param(10.0, "command limit", "N", gt=0.0)


class LagState(NamedTuple):
    x: float = 0.0  # m
    u: float = 0.0  # N


class Lag(Plant[LagParams]):
    """x' = gain (u - x), explicit Euler."""

    INPUTS = (COMMAND, number("offset", "lag/offset", "N", held=True), button("kick", "lag/kick", held=True))
    OUTPUTS = (STATE, joint_state("applied", "lag/applied", ["u"], effort="N"))

    def first(self):
        return LagState()

    def outputs(self, x, t):
        return {"state": (x.x, self.p.gain * (x.u - x.x)), "applied": (x.u,)}

    def advance(self, x, t, command, offset, kick):
        u = command[0] + (offset[0] if offset else 0.0) + (1.0 if kick and kick[0] else 0.0)
        u = max(-self.p.limit, min(self.p.limit, u))
        return LagState(x.x + self.p.period * self.p.gain * (u - x.x), u)


class Source(Block):
    """A sine of the tick number."""

    OUTPUTS = (REFERENCE,)

    def update(self, x, t):
        return x, {"reference": (0.001 * (t // 1_000_000 % 2000),)}


class GainParams(BlockParams):
    k: float = param(2.0, "gain")
    noise: float = param(0.0, "amplitude of seeded noise", ge=0.0)


class Gain(Block[GainParams]):
    """u = k (r - x) + noise; the state is the number of its ticks."""

    INPUTS = (STATE, REFERENCE)
    OUTPUTS = (COMMAND,)

    def first(self):
        return 0

    def update(self, x, t, state, reference):
        noise = self.p.noise * self.standard_normal(x) if self.p.noise else 0.0
        return x + 1, {"command": (self.p.k * (reference[0] - state[0]) + noise,)}


class Outer(Block):
    """Slow outer loop: the reference of the inner one."""

    INPUTS = (STATE, REFERENCE)
    OUTPUTS = (reference("inner", "lag/inner_reference", ["x"], position="m"),)

    def update(self, x, t, state, reference):
        return x, {"inner": (reference[0] + 0.5 * (reference[0] - state[0]),)}


class WatcherParams(BlockParams):
    lingers_after: int = param(0, "samples after which it never comes to an end; 0: it does", ge=0)
    comes_up: bool = param(True, "whether it ever does")


class Watcher(Observer[WatcherParams]):
    """Counts its messages."""

    INPUTS = (STATE, COMMAND)

    def first(self):
        if not self.p.comes_up:
            time.sleep(3600)
        return 0

    def update(self, x, t, state, command):
        return x + 1, {}

    def status(self, x):
        if x == self.p.lingers_after > 0:
            time.sleep(3600)
        return {"seen": (float(x), "")}


class Dawdler(Gain):
    """Takes longer than its peers."""

    def update(self, x, t, state, reference):
        time.sleep(0.005)
        return super().update(x, t, state, reference)


class FaultParams(BlockParams):
    at: float = param(0.5, "time of the fault", "s", ge=0.0)


class Killed(Gain):
    class Params(FaultParams):
        how: str = param("kill", "kill, stop, nan, raise, hang or end")

    def update(self, x, t, state, reference):
        if t >= self.p.at * 1e9:
            if self.p.how == "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.p.how == "stop":
                os.kill(os.getpid(), signal.SIGSTOP)
            if self.p.how == "nan":
                return x, {"command": (float("nan"),)}
            if self.p.how == "end":
                os._exit(0)
            if self.p.how == "hang":
                time.sleep(3600)
            raise ArithmeticError("deliberate")
        return x, {"command": (2.0 * (reference[0] - state[0]),)}


class LinkParams(BlockParams):
    samples: int = param(3, "delay in samples", ge=0)


class DelayedLink(Block[LinkParams]):
    """Publishes the state some samples late, with its acquisition stamp; stores those samples."""

    INPUTS = (STATE,)
    OUTPUTS = (joint_state("late", "lag/late_state", ["x"], position="m", velocity="m/s", delayed=True),)

    def update(self, x, t, state):
        x = (*x, Sample(t, state))[-self.p.samples - 1 :]
        return x, {"late": x[0]}


class LateGain(Block):
    INPUTS = (joint_state("state", "lag/late_state", ["x"], position="m", velocity="m/s", delayed=True), REFERENCE)
    OUTPUTS = (COMMAND,)
    ages: ClassVar[list[int]] = []

    def update(self, x, t, state, reference):
        return x, {"command": (reference[0] - state.data[0] - (t - state.stamp) * 1e-12,)}


class BurstParams(BlockParams):
    at: tuple[float, ...] = param((0.05, 0.12), "times of the events", "s")


class Burst(Block[BurstParams]):
    """Publishes at some ticks only, one of two channels."""

    OUTPUTS = (command("burst", "lag/burst", ["b"], "V", sporadic=True),)

    def update(self, x, t):
        k = [round(at * 1e9) for at in self.p.at]
        return x, {"burst": (float(1 + k.index(t)),) if t in k else None}


class BurstGain(Block):
    """Adds the values of events, for 30 ms."""

    INPUTS = (
        STATE,
        command("burst", "lag/burst", ["a", "b"], ["N", "V"], partial=True, sporadic=True, safe=(0.25, 0.5)),
    )
    OUTPUTS = (COMMAND,)

    def update(self, x, t, state, burst):
        age = self.age("burst")
        fresh = age is not None and age < 30_000_000
        assert self.realtime or self.age("state") == 0
        return x, {"command": (burst[0] + (burst[1] if fresh else -burst[1]) - state[0],)}


class Record(Block):
    """Collects the state, publishes once at the end."""

    INPUTS = (STATE,)
    OUTPUTS = (array("record", "lag/record", {"k": 3}, "m", sporadic=True),)

    def update(self, x, t, state):
        return (*x, state[0]), {}

    def finish(self, x, t, state):
        x = (*x, state[0])
        return x, {"record": (x[min(1, len(x) - 1)], x[-1], float(len(x)))}


class Analyst(Block):
    """Reads the record when it arrives."""

    INPUTS = (array("record", "lag/record", {"k": 3}, "m", held=True, sporadic=True),)
    OUTPUTS = (joint_state("result", "lag/result", ["x"], position="m", sporadic=True),)

    def update(self, x, t, record):  # only published at the end; in real time a delayed node sees the record earlier
        return x, {"result": (record[1] - record[0],)} if record else {}

    finish = update


MATRIX = array("matrix", "lag/matrix", {"row": 1, "column": 2}, "m")
PEAKS = array("peaks", "lag/peaks", {"peak": 2}, "m", sporadic=True)


class Spread(Block):
    """The state as an array."""

    INPUTS = (STATE,)
    OUTPUTS = (MATRIX,)

    def update(self, x, t, state):
        return x, {"matrix": (state[0], 2.0 * state[0])}


class Peaks(Block):
    """The state and its square, at one tick out of three."""

    INPUTS = (STATE,)
    OUTPUTS = (PEAKS,)

    def update(self, x, t, state):
        return x, {"peaks": (state[0], state[0] ** 2)} if t % 30_000_000 == 10_000_000 else {}


class Weigh(Block):
    """A command from both."""

    INPUTS = (MATRIX, PEAKS)
    OUTPUTS = (COMMAND,)

    def update(self, x, t, matrix, peaks):
        return x, {"command": (1.0 - 0.5 * matrix[1] - 0.1 * peaks[1],)}


class Accumulator(Block):
    """y = 1 + 0.5 times its own output, which must come back late."""

    INPUTS = (joint_state("back", "loop/back", ["y"], position="1"),)
    OUTPUTS = (joint_state("sum", "loop/sum", ["y"], position="1"),)

    def update(self, x, t, back):
        return x, {"sum": (1.0 + 0.5 * back[0],)}


class PlannerParams(SolverParams):
    period: float = param(0.1, "sampling period", "s", gt=0.0)
    work: float = param(0.0, "wall-clock time of one plan", "s", ge=0.0)
    fault: str = param("", "raise, kill, hang or (the others take no time) late in the second plan")


class PlannerState(NamedTuple):
    asked: int = 0
    jobs: Jobs = Jobs()


class Planner(Solver[PlannerParams]):
    """Plans the reference that puts the plant onto the wanted one; a plan takes longer than a tick may."""

    INPUTS = (STATE, REFERENCE)
    OUTPUTS = (
        reference("inner", "lag/inner_reference", ["x"], position="m"),
        scalars("plan", "lag/plan", {"asked_at": "s", "repeatable": ""}),
    )

    def first(self):
        return PlannerState()

    def request(self, x, t, state, reference):
        x = PlannerState(x.asked + 1, x.jobs)
        return x, (x.asked, state[0], reference[0], self.p.work, self.p.fault)

    @staticmethod
    def solve(request, work):
        number, x, wanted, seconds, fault = request
        print("a solver that chatters", flush=True)
        if number == 2 and fault == "raise":
            raise ArithmeticError("deliberate")
        if number == 2 and fault == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        work.status(bound=wanted, plan=float(number))
        work.best(wanted + 0.25 * (wanted - x))
        seconds = 3600.0 if fault == "hang" and number == 2 else seconds
        time.sleep(0.0 if fault == "late" and number != 2 else seconds)
        return wanted + 0.5 * (wanted - x)

    def answer(self, x, t, result, new):
        if result is None:
            return x, {"inner": (0.0,), "plan": (-1.0, 1.0)}
        return x, {"inner": (result.answer,), "plan": (result.stamp * 1e-9, float(result.repeatable))}


class Unreadable:
    """Cannot be recreated in another process."""

    def __reduce__(self):
        return int, ("no number",)


def unreadable(request, work):
    return Unreadable()


def deaf(seconds, work):
    """Hold Python's lock for a time."""
    work.best(None)
    ctypes.PyDLL(None).sleep(seconds)


def script():
    """Run a script with arguments, as ``python -c`` does."""
    code, *arguments = sys.argv[1:]
    sys.argv = ["-c", *arguments]
    exec(compile(code, "<script>", "exec"), {"__name__": "__main__"})
