"""Many environments of one rig, moved on by one call of native code."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from itertools import accumulate
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ..block.port import Sample
from ..block.schedule import Plan
from ..block.step import Step
from ..kit.draws import HEAD
from ..native.audience import answered
from ..native.batch_text import Form, batch_text, remembered
from ..native.compile import compiled
from ..native.fitted import NATIVE
from ..native.rig_text import RigText
from ..native.translate import follow
from ..native.twins import form, unpacked
from ..native.value import NotNative
from ..rig.rig import Rig
from ..run.choice import forbidden
from ..timebase import SECOND
from .environment import Now, RigEnv

DRAWS = 4096  # random numbers that each instance has at first; more are drawn when it lacks some
TRIES = 3  # texts that are compiled at most, because each takes seconds


class Columns(Now):
    """The newest values of each signal of all instances, arrays of shape (instances,), by name."""

    def __init__(self, rig: Rig) -> None:
        super().__init__(rig)
        self.rows: NDArray[np.float64] = np.empty((0, 0))
        self.first: dict[str, int] = {}

    def __getitem__(self, name: str) -> Any:
        """Return the newest values of a signal, NaN where it has none yet, or a shared number."""
        if name in self._shared[0]:
            return self._shared[0][name]
        topic, k = self._known[self.whole(name)]
        return self.rows[self.first[topic] + k]


class RigVectorEnv(VectorEnv[Any, Any, Any]):
    """Instances of one rig as environments, each bit-identical to a single `RigEnv`.

    Native code advances all instances within an episode in one call. Python advances an instance whose native tick is
    discarded, and each one at the first and the last step of an episode. An instance whose episode has ended is reset
    by the next step (``AutoresetMode.NEXT_STEP``).

    Parameters
    ----------
    what, replace
        See `RigEnv`.
    reward : callable
        Gets the newest values by name, arrays of shape (num_envs,); returns all rewards. It must work on arrays:
        ``numpy.maximum``, not ``max``.
    make : callable
        Creates the function of a text.
    penalty : float
        See `RigEnv`.
    **keys
        Those of `RigEnv`, but `record`.

    Attributes
    ----------
    envs : list of RigEnv
    native : int
        Number of steps of instances that ran natively.
    reason : str
        Why no steps run natively, or why the newest text was abandoned; empty while they do.

    Examples
    --------
    >>> envs = RigVectorEnv("induction_dtc", "dtc_controller", num_envs=256, reward=lambda now: -abs(now["speed"]))
    """

    def __init__(
        self,
        what: Any,
        replace: str,
        *,
        num_envs: int = 1,
        reward: Callable[[Mapping[str, Any]], Any],
        penalty: float = 0.0,
        make: Callable[[RigText], Callable[..., Any]] = compiled,
        **keys: Any,
    ) -> None:
        first = RigEnv(what, replace, reward=_nothing, **keys)
        self.envs = [first, *(copy(first) for _ in range(num_envs - 1))]
        # A copy shares the attributes of the first one, so each instance gets a dictionary of its own.
        for env in self.envs:
            env.blocks = {}
        self.num_envs, self._reward, self._penalty, self._make = num_envs, reward, penalty, make
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}
        self.single_observation_space, self.single_action_space = first.observation_space, first.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.native, self.reason = 0, forbidden()
        self.now = Columns(first.rig)
        self._tries = TRIES
        self._text: RigText | None = None
        self._ended = np.zeros(num_envs, np.bool_)
        # For instances in Python: the states before the agent's tick, from which native code continues.
        self._before: list[Any] = [None] * num_envs
        self._k = np.full(num_envs, -1)  # ticks of the instances that are native
        self._fits = np.zeros(num_envs, np.bool_)  # whether the text applies to the instance
        self._t = np.zeros(num_envs)
        self._last = 0  # first tick whose step is the last one

    # Gymnasium's own ----------------------------------------------------------------------------------------------

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in all instances.

        Parameters
        ----------
        seed : int or sequence of (int or None), optional
            Of the first, the next one has seed + 1; or one each.
        options : dict, optional
            None are known.
        """
        many = isinstance(seed, int | np.integer) and [int(seed) + j for j in range(self.num_envs)]
        seeds = many or (seed or [None] * self.num_envs)
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds, expected {self.num_envs}")
        self._ended[:] = False
        results = [self._begun(j, each) for j, each in enumerate(seeds)]
        return np.array(results), self._info({})

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Apply the actions until the agents' next ticks.

        Parameters
        ----------
        actions : array, shape (num_envs, actions)

        Raises
        ------
        ValueError
            Another shape, a value or a reward that is not finite.
        """
        rows = np.ascontiguousarray(actions, np.float64)
        if rows.shape != self.action_space.shape or not np.isfinite(rows).all():
            raise ValueError(f"expected actions of {self.action_space.shape} finite numbers, got {actions!r}")
        terminated, truncated = np.zeros((2, self.num_envs), np.bool_)
        errors: dict[int, str] = {}
        late: dict[int, Any] = {}

        def by_python(j: int) -> None:
            self._loaded(j)
            late[j], _, terminated[j], truncated[j], info = self.envs[j].step(rows[j])
            if terminated[j]:
                errors[j] = info["error"]
            self._store_outputs(j)

        begun = self._ended
        for j in np.flatnonzero(begun).tolist():
            late[j] = self._begun(j, None)
        for j in np.flatnonzero(~begun & ((self._k < 0) | (self._k >= self._last))).tolist():
            by_python(j)
        if self._text is not None and len(late) < self.num_envs:
            self._moved(rows, by_python)
        observed = np.empty((self.num_envs, len(self.envs[0].held)))
        for column, index in enumerate(self._observes if len(late) < self.num_envs else ()):
            observed[:, column] = self.now.rows[index] if type(index) is int else index
        for j, row in late.items():
            observed[j] = row
        for j in late:
            if not (begun[j] or terminated[j] or truncated[j]):
                self._packed(j)
        rewards = np.array(np.broadcast_to(self._reward(self.now), (self.num_envs,)), np.float64)
        rewards[terminated] += self._penalty
        # In Gymnasium's mode NEXT_STEP the step after an episode only resets, and its reward is 0.
        rewards[begun] = 0.0
        if not np.isfinite(rewards).all():
            worst = int(np.argmin(np.isfinite(rewards)))
            raise ValueError(f"the reward of {worst} became {rewards[worst]} at t = {self._t[worst]:.9g} s")
        self._ended = terminated | truncated
        return observed, rewards, terminated, truncated, self._info(errors)

    # in Python ----------------------------------------------------------------------------------------------------

    def _begun(self, j: int, seed: int | None) -> Any:
        """Begin an episode; returns its observation."""
        env, self._k[j], self._fits[j], self._before[j] = self.envs[j], -1, False, None
        env.over = None
        observation, _ = env.reset(seed=seed)
        if self.now.rows.shape[1] != self.num_envs:
            sizes = [p.size for s in env.steps.values() for p in s.outputs]
            topics = [p.topic for s in env.steps.values() for p in s.outputs]
            ends = [0, *accumulate(sizes)]
            self.now.first = dict(zip(topics, ends, strict=False))
            self.now.rows = np.full((ends[-1], self.num_envs), np.nan)
        self.now.rows[:, j] = np.nan
        env.over = lambda: self._after(j)
        self._store_outputs(j)
        return observation

    def _after(self, j: int) -> None:
        """Store the state of an instance after a tick."""
        steps = list(self.envs[j].steps.values())
        self._before[j] = None if self.reason else [(s.x, s.numbers) for s in steps]

    def _store_outputs(self, j: int) -> None:
        """Store the outputs of an instance."""
        now = self.envs[j].now
        for topic, row in now.published.items():
            values = row.data if isinstance(row, Sample) else row
            self.now.rows[self.now.first[topic] : self.now.first[topic] + len(values), j] = values
        self._t[j] = self.envs[j].clock.t / SECOND

    def _loaded(self, j: int) -> None:
        """Restore an instance into the steps, so that it continues in Python."""
        if self._k[j] < 0:
            return
        env, k = self.envs[j], int(self._k[j])
        states, outputs = self._form.get(self._numbers[j], self._whole[j])
        for s, x, numbers in zip(env.steps.values(), states, outputs, strict=True):
            if s.name != env.member.name:
                s.x = unpacked(x)
            answered(s, (k - 1) // self._plan.every(s.schedule), numbers)
        self._k[j] = -1
        env.over = None
        env.begin(k)
        env.over = lambda: self._after(j)

    # native -------------------------------------------------------------------------------------------------------

    def _packed(self, j: int) -> None:
        """Advance an instance by native code, if code for it exists or can be compiled."""
        env = self.envs[j]
        if self.reason or self._before[j] is None:
            return
        steps, agent = list(env.steps.values()), env.steps[env.member.name]
        try:
            state = remembered(agent, steps, self._before[j])
            if self._text is None or form(state) != self._forms:
                self._texted(steps, agent, state)
        except NotNative as reason:
            self.reason = str(reason)
            return
        if not self._fits[j] and not self._fitted(j):
            return
        self._form.put(state, self._numbers[j], self._whole[j])
        self._k[j] = self._plan.clock.tick(env.clock.t)

    def _fitted(self, j: int) -> bool:
        """Return whether the text fits an instance whose episode has begun; if so, store its random numbers."""
        assert self._text is not None
        program, blocks = self._text.program, [s.block for s in self.envs[j].steps.values()]
        self._fits[j] = not program.differs(blocks) and program.constants(blocks) == self._constants
        for path, name in program.draws.items() if self._fits[j] else ():
            self._tables[name][j, HEAD:] = follow(path, blocks).first(self._tables[name].shape[1] - HEAD)
        return bool(self._fits[j])

    def _texted(self, steps: list[Step], agent: Step, state: Any) -> None:
        """Create the text for the states as they are."""
        # Each text takes seconds of compiling, so an instance whose state keeps changing its type stays in Python.
        if not self._tries:
            raise NotNative("its state changes its type")
        odd = [s.name for s in steps if s.changes or any(p.sporadic or p.delayed or p.unchecked for p in s.outputs)]
        if odd:
            raise NotNative(f"{odd[0]}: it does not publish at each tick, or its parameters change")
        # Native instances have their state in the form of the old text, so they return to Python before it is replaced.
        self._tries -= 1
        for j in np.flatnonzero(self._k >= 0).tolist():
            self._loaded(j)
        self._form, self._forms = Form(state), form(state)
        params: Any = self.envs[0].member.params
        bounds = dict(zip(params.act, params.bounds(), strict=True))
        messages = []
        for port in agent.outputs:
            for label, safe in zip(port.labels, port.safe, strict=True):
                signal = f"{port.topic}/{label}"
                if signal not in bounds:
                    messages.append(repr(float(safe)))
                    continue
                a, (low, high) = f"a[{params.act.index(signal)}]", bounds[signal]
                messages.append(f"({low!r} if {a} < {low!r} else {high!r} if {a} > {high!r} else {a})")
        text = batch_text(steps, agent, messages, self._form)
        blocks = [s.block for s in steps]
        program = text.program
        self._plan = Plan(s.schedule for s in steps)
        ticks = self._plan.ticks or 0
        self._times = self._plan.clock.times(0, ticks + 1) / SECOND
        self._last = ticks - self._plan.every(agent.schedule)
        self._constants = program.constants(blocks)
        self._tables = dict(zip(program.arrays.values(), program.tables(blocks), strict=True))
        self._tables |= {name: follow(path, blocks).scratch() for path, name in program.scratches.items()}
        self._tables |= {name: np.zeros((self.num_envs, DRAWS)) for name in program.draws.values()}
        self._numbers = np.zeros((self.num_envs, self._form.sizes[0]))
        self._whole = np.zeros((self.num_envs, self._form.sizes[1]), np.int64)
        self._observes = self._places(steps, agent)
        self._fits[:] = False
        self._function = self._make(text)
        self._text = text

    def _places(self, steps: list[Step], agent: Step) -> list[Any]:
        """Return the place of each value of an observation among all outputs, or the value if it is constant."""
        first = dict(zip(map(id, steps), [0, *accumulate(len(s.numbers) for s in steps)], strict=False))
        block: Any = agent.block
        result: list[Any] = []
        for port, k in block.observed:
            fill = agent.fed.get(port.name)
            index = port.safe[k] if fill is None else fill.places[k]
            if fill is not None and type(index) is int:
                index += first[id(fill.source)] + sum(p.size for p in fill.source.outputs[: fill.output])
            result.append(index)
        return result

    def _moved(self, actions: Any, by_python: Callable[[int], None]) -> None:
        """Advance the native instances; Python runs the steps that native code discards."""
        assert self._text is not None
        begin, n = 0, np.zeros(2, np.int64)
        while begin < self.num_envs:
            tables = [self._tables[name] for name in self._text.arrays]
            n[:] = 0
            try:
                self._function(
                    begin,
                    self.num_envs,
                    n,
                    self._constants,
                    self._numbers,
                    self._whole,
                    self.now.rows,
                    actions,
                    self._k,
                    *tables,
                )
                break
            except NATIVE:
                # The call stops at an instance that it cannot advance: `n` has its number, and how many random numbers
                # it lacks.
                begin = int(n[0])
                if n[1]:
                    self._drawn(int(n[1]))
                else:
                    by_python(begin)
                    begin += 1
            except Exception as error:
                # numba compiles at the first call, so a text that it cannot compile fails here.
                if type(error).__module__.partition(".")[0] != "numba":
                    raise
                self.reason = f"numba: {' '.join(str(error).split())[:300]}"
                for j in np.flatnonzero(self._k >= 0).tolist():
                    by_python(j)
                self._text = None
                return
        moved = self._k >= 0
        self.native += int(moved.sum())
        self._t[moved] = self._times[self._k[moved]]

    def _drawn(self, count: int) -> None:
        """Draw more random numbers of each instance."""
        assert self._text is not None
        for path, name in self._text.program.draws.items():
            old = self._tables[name]
            self._tables[name] = result = np.zeros((self.num_envs, HEAD + max(count, 2 * old.shape[1])))
            for j in np.flatnonzero(self._fits):
                blocks = [s.block for s in self.envs[j].steps.values()]
                result[j, HEAD:] = follow(path, blocks).first(result.shape[1] - HEAD)

    def _info(self, errors: Mapping[int, str]) -> dict[str, Any]:
        info: dict[str, Any] = {"t": self._t.copy(), "_t": np.ones(self.num_envs, np.bool_)}
        for j, error in errors.items():
            info = self._add_info(info, {"error": error}, j)
        return info


def _nothing(now: Now) -> float:
    return 0.0
