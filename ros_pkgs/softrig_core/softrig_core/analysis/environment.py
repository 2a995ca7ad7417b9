"""A rig as an environment of the Gymnasium library: an agent replaces a controller."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from ..arrays import Array
from ..block.answer import Rows
from ..block.block import Observer
from ..block.held import ByHand
from ..block.link import Link
from ..block.loop import Loop
from ..block.params import flatten
from ..block.port import Port, Sample
from ..block.step import Step
from ..errors import RunError, ScenarioError, closest
from ..extras import need
from ..rig.members import Member, signal_units
from ..rig.rig import Rig
from ..run.expand import rig_of
from ..run.inprocess import record, wired
from ..run.simulate import Run
from ..scenario.port_text import ports_text, reader
from ..scenario.references import pick
from ..scenario.scenario import NodeEntry, Scenario
from ..timebase import SECOND
from ..verdict.requirements import names_of
from ..wire.recording import Recording
from ..wire.signals import full_name

need("gymnasium", "RigEnv")

import gymnasium as gym  # noqa: E402
import numpy as np  # noqa: E402

Signals = Sequence[str] | Mapping[str, tuple[float, float]]


class _Watched(Link):
    """Stores the newest values that a step publishes, in addition to the action of its link."""

    def __init__(self, step: Step, published: dict[str, Any]) -> None:
        super().__init__(step)
        self._published, self._topics = published, [p.topic for p in step.outputs]

    def send(self, t: int, rows: Rows, numbers: tuple[float, ...]) -> None:
        """Publish an answer, and store its values as the newest ones."""
        for topic, row in zip(self._topics, rows, strict=True):
            if row is not None:
                self._published[topic] = row
        super().send(t, rows, numbers)


class _Acts(Link):
    """A link that makes its step wait until the agent has set an action."""

    def __init__(self, step: Step, waits: Callable[[], bool]) -> None:
        super().__init__(step)
        self._waits = waits

    def lacks(self, t: int) -> bool:
        """Return whether the action of this tick is still missing."""
        return self._waits()


class Now(Mapping[str, float]):
    """The newest value of each signal of a rig, by ``topic/channel/field`` or the scenario's shared name."""

    def __init__(self, rig: Rig) -> None:
        self._known = {f"{t}/{label}": (t, k) for t, p in rig.topics.items() for k, label in enumerate(p.labels)}
        self._shared = names_of(rig, signal_units(rig))
        self.published: dict[str, Any] = {}

    def whole(self, name: str) -> str:
        """Return the whole name of a signal, called by its own or a shared name.

        Raises
        ------
        ScenarioError
            There is no such signal.
        """
        result = full_name(self._shared[1].get(name, name), self._known)
        if result not in self._known:
            raise ScenarioError(f"no signal {name!r}{closest(name, [*self._known, *self._shared[1]])}")
        return result

    def __getitem__(self, name: str) -> float:
        """Return the newest value of a signal, or a shared number; raise a KeyError if the signal has no sample yet."""
        if name in self._shared[0]:
            return self._shared[0][name]
        topic, k = self._known[self.whole(name)]
        row = self.published[topic]
        return float((row.data if isinstance(row, Sample) else row)[k])

    def __iter__(self) -> Iterator[str]:
        """Iterate over the signals that have a value."""
        return (name for name, (topic, _) in self._known.items() if topic in self.published)

    def __len__(self) -> int:
        """Return the number of signals that have a value."""
        return sum(1 for _ in self)


class RigEnv(gym.Env[Array, Array]):
    """A rig in which an agent replaces one controller.

    A step of the environment is a period of that controller. The agent takes the place of the node
    ``softrig_control/policy``: a trained agent can be used as that node (`scenario`), with the same numbers.

    Parameters
    ----------
    what : str, Scenario or Rig
        As in `simulate`.
    replace : str
        Node that the agent replaces; not a plant.
    observe : sequence of str, or mapping to (low, high), optional
        Signals of an observation, by their own or shared names, and their bounds; default: all that the controller
        reads, within the limits of its ports.
    act : sequence of str, or mapping to (low, high), optional
        Signals of an action among those that the controller publishes; default: all of them. The others keep their
        ports' safe values. An action is clipped to its bounds, and these to the limits of the ports.
    reward : callable
        Gets `Now`, the newest values by name, after each step; returns the reward.
    terminate : sequence of str
        Requirements of the scenario whose violation ends an episode.
    penalty : float
        Added to the reward of the step at which an episode was terminated: a requirement was violated, a value left
        its port's limits, or a node failed.
    record : bool
        Keep all messages of an episode for `run`.
    duration, overrides
        See `rig_of`.

    Attributes
    ----------
    rig : Rig
        Rig with the node ``policy`` in the place of the controller.
    now : Now
        Newest values of the current episode.
    member : Member
        The node ``policy``.
    blocks, steps : dict
        Blocks and steps of the rig's members, by name; `clock` is the step of the member that publishes the time.
    held : ndarray
        The observation of the agent's tick.
    over : callable or None
        Called after each tick.

    Raises
    ------
    ScenarioError
        No such node, signal or requirement, or the agent observes a value that it publishes at the same tick.

    Notes
    -----
    ``reset(seed=n)`` runs the rig with the seed `n`; without `seed` it is drawn from ``np_random``. An episode is
    truncated at the end of the run. ``info["t"]`` is the time in s, ``info["error"]`` why an episode was terminated.

    Examples
    --------
    >>> env = RigEnv("induction_dtc", "dtc_controller", reward=lambda now: -abs(now["speed"] - now["set_speed"]))
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(
        self,
        what: str | Scenario | Rig,
        replace: str,
        *,
        reward: Callable[[Now], float],
        observe: Signals | None = None,
        act: Signals | None = None,
        terminate: Sequence[str] = (),
        penalty: float = 0.0,
        record: bool = False,
        duration: float | None = None,
        overrides: Mapping[str, Any] | None = None,
    ) -> None:
        self._whole = rig_of(what, duration=duration, overrides=overrides)
        self._law = _law(self._whole, replace)
        self._reward, self._penalty, self._record = reward, penalty, record
        self._entry = _entry(self._whole, self._law, observe, act)
        self.rig = self._with(self._entry, terminate)
        self.member = member = next(m for m in self.rig.members if m.name == replace)
        params: Any = member.params
        self.observation_space = _box(_bounds(observe, params.observe, _limits(member.inputs)))
        self.action_space = _box(params.bounds())
        self.blocks: dict[str, Any] = {}
        self.steps: dict[str, Step] = {}
        self._ticks: Iterator[int | None] | None = None
        self._action: Array | None = None
        self.held: Array = np.zeros(self.observation_space.shape or (0,))
        self.now = Now(self.rig)
        self.run: Run | None = None
        self.over: Callable[[], object] | None = None  # called after each tick

    # Gymnasium's own ----------------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode.

        Parameters
        ----------
        seed : int, optional
            Of the rig; drawn when there is none.
        options : dict, optional
            None are known.
        """
        super().reset(seed=seed)
        number = int(self.np_random.integers(2**31)) if seed is None else seed
        # The set-up of a block may take long, so blocks are kept from episode to episode.
        if self.blocks:
            for block in self.blocks.values():
                block.reset(number)
        else:
            # Nobody reads the figures of an observer without outputs during an episode, so it runs only for a record.
            members = [
                m for m in self.rig.members if self._record or m.outputs or not issubclass(m.block_class, Observer)
            ]
            self.blocks = {m.name: m.block(number) for m in members}
        self._number = number
        self.steps = steps = wired(self.rig, self.blocks)
        self._agent, self.clock = steps[self._law.name], steps[self.rig.clock.name]
        self._agent.x = self._agent.x._replace(act=self._current_action)
        self.now = Now(self.rig)
        self.run = None
        if self._record:
            recording = Recording((topic, port.msgtype) for topic, port in self.rig.topics.items())
            record(self.rig, steps, recording)
            self.run = Run(self.rig, number, recording, blocks=dict(steps))
        for step in steps.values():
            _Watched(step, self.now.published)
        # The agent lacks a value until `step` sets the action, so the loop stops at its tick.
        _Acts(self._agent, lambda: self._action is None)
        self._action, self._started = None, time.perf_counter()
        self.begin()
        return self.held.copy(), self._info()

    def begin(self, tick: int = 0) -> None:
        """Continue a run from one of its ticks, at which the steps hold the state before it, up to the agent's next
        tick.
        """
        self._ticks = Loop(list(self.steps.values())).run(tick)
        ended = self._go_on()
        if ended:
            raise RunError(ended if isinstance(ended, str) else f"{self._law.name} has no tick in this run")

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Apply the agent's action until its next tick.

        Parameters
        ----------
        action : array, shape (actions,)
            In the units of its signals.

        Raises
        ------
        ValueError
            Another number of values, or one that is not finite.
        RuntimeError
            No episode is under way.
        """
        if self._ticks is None:
            raise RuntimeError("no episode is under way: reset() begins one")
        values = np.asarray(action, dtype=np.float64)
        if values.shape != self.action_space.shape or not np.isfinite(values).all():
            raise ValueError(f"expected an action of {self.action_space.shape} finite numbers, got {action!r}")
        self._action = values
        ended = self._go_on()
        terminated = isinstance(ended, str)
        info = self._info() | ({"error": ended} if terminated else {})
        if ended:
            self._ticks = None
            if self.run is not None:
                self.run.wall_s = time.perf_counter() - self._started
                self.run.error = info.get("error", "")
        reward = float(self._reward(self.now)) + (self._penalty if terminated else 0.0)
        if not math.isfinite(reward):
            raise ValueError(f"the reward became {reward} at t = {info['t']:.9g} s")
        return self.held.copy(), reward, terminated, ended is True, info

    # the rig around the agent -------------------------------------------------------------------------------------

    def published(self) -> Callable[[Array], Array]:
        """Return the controller itself as an agent of the current episode; its actions are all its outputs.

        It reads the ports, because an observation cannot express that no message has arrived yet.

        Raises
        ------
        ScenarioError
            The actions are only some of the controller's outputs, or it may be silent.
        """
        outputs = self._law.outputs
        if self.action_space.shape != (sum(p.size for p in outputs),) or any(p.sporadic for p in outputs):
            raise ScenarioError(f"{self._law.name} publishes more than the actions of this environment can set")
        block = self._law.block(self._number)
        # The controller has no step of its own; its inputs are as old as those of the agent's.
        block.ages = self._agent.age
        law = ByHand(block)
        names = [p.name for p in self._law.inputs]

        def agent(_: Array) -> Array:
            answer = law.update(self.clock.t, **{name: self._agent.values[name] for name in names})
            rows = [answer[p.name] for p in outputs]
            return np.array([x for row in rows for x in (row.data if isinstance(row, Sample) else row or ())])

        return agent

    def scenario(self, policy: str, weights: Sequence[float], name: str = "") -> Scenario:
        """Return the scenario with a trained policy as the node in the controller's place.

        Parameters
        ----------
        policy : str
            ``linear``, or the name of an entry point ``module:callable`` in the group softrig_policies.
        weights : sequence of float
            Learned weights of the policy.
        name : str
            Name of the new scenario; default: that of the old one.
        """
        learned = {"policy": policy, "weights": [float(w) for w in weights]}
        entry = self._entry.model_copy(update={"parameters": {**self._entry.parameters, **learned}})
        result = self._with(entry, ()).scenario
        return result.model_copy(update={"name": name} if name else {})

    def _with(self, entry: NodeEntry, terminate: Sequence[str]) -> Rig:
        """Return the rig with another node in the controller's place, and requirements that end a run."""
        scenario = self._whole.scenario
        for name in terminate:
            if name not in scenario.requirements:
                known = ", ".join(scenario.requirements) or "it has none"
                raise ScenarioError(f"{scenario.name}: no requirement {name!r}; expected one of {known}")
        # References to the controller's parameters would be lost with it, because the policy in its place has other
        # ones.
        data = _without(self._law, scenario.model_dump())
        data["nodes"][self._law.name] = entry.model_dump()
        for name in terminate:
            data["requirements"][name]["ends"] = True
        classes = {m.name: m.block_class for m in self._whole.members if m.name != self._law.name}
        return rig_of(Scenario.model_validate(data), classes=classes)

    def _current_action(self, _: Sequence[float]) -> list[float]:
        """Return the action of the current step as the policy of the agent's node, and use it up."""
        # The action is used up, so the loop stops again at the agent's next tick.
        action, self._action = self._action, None
        assert action is not None
        return [float(a) for a in action]

    def _go_on(self) -> str | bool:
        """Run up to the agent's next tick; return whether it was the last, or why the rig failed."""
        assert self._ticks is not None
        try:
            for t in self._ticks:
                if t is None:
                    self._observe()
                    return False
                if self.over is not None:
                    self.over()
        except RunError as error:
            return str(error)
        self._observe()
        return True

    def _observe(self) -> None:
        block: Any = self._agent.block
        self.held = np.array(block.observation(self._agent.values), dtype=np.float64)

    def _info(self) -> dict[str, Any]:
        return {"t": self.clock.t / SECOND}


def _law(rig: Rig, name: str) -> Member:
    laws = [m.name for m in rig.members if not m.is_plant and m.outputs]
    for member in rig.members:
        if member.name == name and name in laws:
            return member
    reason = "is a plant or publishes nothing" if any(m.name == name for m in rig.members) else "is not there"
    raise ScenarioError(f"{rig.scenario.name}: replace {name!r}: it {reason}; expected one of {', '.join(laws)}")


def _without(law: Member, value: Any) -> Any:
    """Copy plain data, with the values of a controller's parameters in place of references to them."""
    if isinstance(value, str):
        reference = rf"(?<!\$)\${re.escape(law.name)}\.([\w.]+)"
        if single := re.fullmatch(reference, value):
            return pick(flatten(law.params), single[1])
        # Within a formula or arithmetic the value stands in brackets, because it may be negative.
        return re.sub(reference, lambda match: f"({pick(flatten(law.params), match[1])!r})", value)
    if isinstance(value, Mapping):
        return {k: _without(law, v) for k, v in value.items()}
    return [_without(law, v) for v in value] if isinstance(value, list | tuple) else value


def _entry(rig: Rig, law: Member, observe: Signals | None, act: Signals | None) -> NodeEntry:
    """Return the node that replaces a controller: its ports, and the other observed signals."""
    now, arrived = Now(rig), list(law.inputs)
    observed = None if observe is None else [now.whole(name) for name in observe]
    for signal in observed or ():
        if signal not in _limits(arrived):
            port = next(p for p in rig.topics.values() if signal in _limits([p]))
            arrived.append(reader(port, f"observed_{len(arrived)}"))
    observed = list(_limits(arrived)) if observed is None else observed
    acted = [now.whole(name) for name in act] if act is not None else list(_limits(law.outputs))
    for signal in acted:
        if signal not in _limits(law.outputs):
            known = ", ".join(_limits(law.outputs))
            raise ScenarioError(f"{rig.scenario.name}: act: {law.name} does not publish {signal}; it publishes {known}")
    parameters: dict[str, Any] = {
        "period": flatten(law.params)["period"],
        "policy": "linear",
        # These weights never act: `reset` puts the actions of `step` in the place of the policy.
        "weights": [0.0] * (len(acted) * (len(observed) + 1)),
        "inputs": ports_text(arrived),
        "outputs": ports_text(law.outputs),
        "observe": observed,
        "act": acted,
    }
    bounds = _bounds(act, acted, _limits(law.outputs))
    parameters |= {"low": [low for low, _ in bounds], "high": [high for _, high in bounds]}
    return NodeEntry(package="softrig_control", executable="policy", parameters=parameters)


def _limits(ports: Sequence[Port]) -> dict[str, float]:
    """Return the limit of each signal of some ports."""
    return {f"{p.topic}/{label}": m for p in ports for label, m in zip(p.labels, p.limits, strict=True)}


def _bounds(bounds: Signals | None, signals: Sequence[str], limits: Mapping[str, float]) -> list[tuple[float, float]]:
    """Return the bounds of signals: those of a mapping, in its order, or the limits of their ports."""
    if isinstance(bounds, Mapping):
        return [(float(low), float(high)) for low, high in bounds.values()]
    return [(-limits[s], limits[s]) for s in signals]


def _box(bounds: Sequence[tuple[float, float]]) -> Any:
    low, high = (np.array(side, dtype=np.float64) for side in zip(*bounds, strict=True))
    return gym.spaces.Box(low, high, dtype=np.float64)


gym.register(
    "softrig/Rig-v0", entry_point=f"{__name__}:RigEnv", vector_entry_point=f"{__package__}.environments:RigVectorEnv"
)
