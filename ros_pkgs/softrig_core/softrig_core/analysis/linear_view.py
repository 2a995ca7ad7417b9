r"""The linear view of a rig: its state space with named states where a run is, and any loop opened at a link.

The columns are two-sided differences of the rig as a map (`state_map`), each with the step at which two neighbouring
steps agree best. For a state in which the map is linear (a linear block, a delay) the largest step is exact to
rounding, and for copies exact. With the loop opened at a link, the value that its readers receive is held:

.. math:: x_{k+1} = A x_k + b v_k, \quad s_k = c x_k + d v_k, \quad L(z) = -c (z - A)^{-1} b - d

is the opened loop of negative feedback, and the rig is it with :math:`v = s`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from itertools import repeat
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import RunError, ScenarioError
from ..extras import need
from ..rig.members import signal_units
from ..rig.rig import Rig
from ..run.expand import rig_of
from ..scenario.scenario import Scenario
from .crossings import gain_crossings, phase_crossings, resolved
from .state_map import StateMap, is_source, place_of, signal_of, upstream

if TYPE_CHECKING:
    import control

# Powers of two are added to a state without rounding where this is possible.
STEPS = tuple(2.0**-n for n in range(4, 33, 4))  # shares of the size of the state or input that is moved
AGREED = 1e-11  # difference of neighbouring steps below which smaller steps are not tried
CHECKED = 10  # periods of the whole over which the linear rig is compared with the rig
COMPARED_PERIODS = 40  # periods over which each output is compared
# An output may be off by this share of its largest value; where the states are off, by a hundred times as much as they.
LEFT_OUT = 1e-3
LATER = 3  # further periods at which the rows of an output are computed, because they may differ from tick to tick
FOLLOWED = 200  # periods that may be run from the state of the view
# All states together are moved by this share of the steps of their columns.
NEARER = 2.0**-8
ROUNDS = 5  # rounds in which sizes are found for states that are zero in the run
POINTS = 1000  # frequencies
MOST = 800  # states; a long delay has more, and longer steps make them fewer
TRIED = 2000  # numbers that may be moved to see whether they are states
ON_CIRCLE = 1e-6  # a least singular value of z - A below this share of the sizes of z and A confirms a pole at z
NOTHING = 1e-12  # a sum below this share of the sizes of its terms is rounding alone
DEAD = 1e-4  # magnitude of a pole below which its motion ends within a period


class Margins(NamedTuple):
    """The distances of a loop from a change of its stability; infinite without a crossing."""

    gain: float
    """Factor by which the loop's gain may grow, 1."""

    gain_down: float
    """Factor down to which it may fall, 1; 0 where it may vanish."""

    phase: float
    """Phase that may be lost, rad."""

    delay: float
    """Delay that may be added, s."""

    disk: float
    """Diameter of the largest disk of gain and phase together (skew 0), 1."""

    crossover: float
    """Highest frequency at which the gain is one, rad/s; NaN where it never is."""


class Mode(NamedTuple):
    """A pole and the states that take part in it."""

    pole: complex
    """In z."""

    rate: complex
    """log(pole) / period, rad/s: the pole in s that it stands for."""

    shares: dict[str, float]
    """Participation of each state (left times right eigenvector, magnitudes that add up to 1), the largest first."""


@dataclass(frozen=True)
class LinearView:
    """A rig, linearised around the state of a run.

    Parameters
    ----------
    rig : str
        Name of the scenario.
    at : float
        Time of the linearisation, s.
    period : float
        Period of the whole rig, which is the sample time of the state space, s.
    states, inputs, outputs : tuple of str
        States are ``member.attribute``, the others signals.
    units : dict of str to str
        Unit of each signal.
    values : dict of str to float
        Values of states and signals at that time.
    A, B, C, D : array
        Matrices of the whole rig, shapes (n, n), (n, inputs), (outputs, n), (outputs, inputs).
    link : str
        Signal at which the loop is opened; empty: nowhere.
    a, b, c, d : array
        Matrices of the rig opened there: shapes (n, n), (n,), (n,), ().
    error : float
        Largest difference of a column between its step and the neighbouring one, relative to its largest entry.
    worst : str
        The state or input of that column.
    output_errors : dict of str to float
        For each output the largest difference between the linear rig and the rig over 40 periods, both started with a
        small offset in all states, relative to the largest change of the output in that time.
    left_out : dict of str to str
        Outputs that are not functions of the states, and why: they turn with an angle, belong to some ticks alone, or
        change in steps.
    state_error : float
        Largest difference between the linear rig and the rig after each of ten periods, both started with a small
        offset in all states, relative to the largest difference to the run without offset. It is large for a rig that
        changes from period to period. For an opened loop only its own states count, since a state outside the loop
        that rests on a limit does not affect it.
    """

    rig: str
    at: float
    period: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    values: Mapping[str, float]
    A: Array
    B: Array
    C: Array
    D: Array
    link: str
    a: Array
    b: Array
    c: Array
    d: float
    error: float
    worst: str
    state_error: float
    output_errors: Mapping[str, float] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def closed(self) -> control.StateSpace:
        """Return the whole rig as a system of the python-control library, with the names of its states and signals.

        Its `margin` searches for crossings between frequencies and does not detect a pole that leaves the unit circle
        at z = -1 or 1 (a gain margin of infinity where 540 is right): use `margins`.
        """
        need("control", "a system of python-control")
        import control

        return control.ss(
            self.A,
            self.B,
            self.C,
            self.D,
            self.period,
            states=list(self.states),
            inputs=list(self.inputs),
            outputs=list(self.outputs),
        )

    @cached_property
    def opened(self) -> control.StateSpace:
        """The loop L opened at the link, with the states that depend on the link and on which it depends.

        `control.margin` does not detect a pole that leaves the unit circle at z = -1 or 1: use `margins`.
        """
        need("control", "a system of python-control")
        import control

        A, b, c, d, names = self._loop
        return control.ss(A, b[:, None], -c[None, :], -d, self.period, states=names, inputs=["in"], outputs=["out"])

    @cached_property
    def _loop(self) -> tuple[Array, Array, Array, float, list[str]]:
        if not self.link:
            raise ScenarioError(f"{self.rig}: no link is opened")
        on = _between(self.a, self.b, self.c)
        names = [name for name, used in zip(self.states, on, strict=True) if used]
        return self.a[np.ix_(on, on)], self.b[on], self.c[on], self.d, names

    @cached_property
    def loop_poles(self) -> NDArray[np.complex128]:
        """Poles of the loop closed at the link."""
        A, b, c, d, _ = self._loop
        result: NDArray[np.complex128] = np.linalg.eigvals(A + np.outer(b, c) / (1.0 - d)).astype(complex)
        return result

    @property
    def stable(self) -> bool:
        """Return whether the loop at the link is stable; without a link, whether the rig is."""
        poles = self.loop_poles if self.link else np.linalg.eigvals(self.A)
        return bool(np.abs(poles).max(initial=0.0) < 1.0)

    @cached_property
    def modes(self) -> list[Mode]:
        """Return the poles of the rig with their states, the slowest first, without those that decay in a period."""
        poles, right = np.linalg.eig(self.A) if self.states else (np.empty(0), np.empty((0, 0)))
        # A delay makes A defective: its poles at zero share an eigenvector, and such a matrix of eigenvectors has no
        # inverse.
        left = np.linalg.pinv(right)
        result = []
        for k in np.argsort(-np.abs(poles)):
            # A pole near zero is gone within a period, and of a complex pair one stands for both.
            if abs(poles[k]) < DEAD or poles[k].imag < 0.0:
                continue
            shares = np.abs(left[k] * right[:, k])
            shares /= shares.sum()
            order = [i for i in np.argsort(-shares) if shares[i] > 0.01]
            result.append(
                Mode(
                    complex(poles[k]),
                    complex(np.log(complex(poles[k]))) / self.period,
                    {self.states[i]: float(shares[i]) for i in order},
                )
            )
        return result

    @cached_property
    def omega(self) -> Array:
        """Frequencies up to that of Nyquist, rad/s, dense where poles of the opened or closed loop are near."""
        # At the frequency of Nyquist itself L is real, and `_ends` looks at it.
        top = np.pi / self.period * (1.0 - 1e-9)
        poles = np.concatenate([np.linalg.eigvals(self._loop[0]).astype(complex), self.loop_poles])
        rates = np.log(poles[np.abs(poles) > DEAD]) / self.period
        # An integrator has the rate 0, which has no place on a logarithmic axis.
        slow = np.abs(rates[np.abs(rates) > 1e-9 * top])
        low = max(1e-7 * top, min(0.01 * slow.min(initial=top), 1e-2 * top))
        results = [np.geomspace(low, top, POINTS)]
        for rate in rates:
            width = max(abs(rate.real), 1e-6 * abs(rate.imag))
            # A lightly damped pole is narrower than the spacing of the other frequencies.
            if 0.0 < width < 0.1 * abs(rate.imag):
                results.append(abs(rate.imag) + width * np.linspace(-5.0, 5.0, 41))
        grid = np.unique(np.concatenate(results))
        return grid[(grid >= low) & (grid <= top)]

    def at_frequencies(self, omega: Array) -> NDArray[np.complex128]:
        """Return the opened loop L(exp(j omega T)).

        Parameters
        ----------
        omega : array, shape (n,)
            rad/s.
        """
        _, b, _, d, _ = self._loop
        if not len(b):
            return np.full(len(omega), -d, dtype=complex)
        import scipy.linalg

        # In triangular form each frequency costs a substitution instead of a factorisation.
        T, left, right = self._triangular
        eye, points = np.eye(len(b)), np.exp(1j * np.asarray(omega) * self.period)
        return np.array([-left @ scipy.linalg.solve_triangular(z * eye - T, right) - d for z in points], dtype=complex)

    @cached_property
    def _triangular(self) -> tuple[NDArray[np.complex128], NDArray[np.complex128], NDArray[np.complex128]]:
        """The opened loop's A in Schur's form, with c and b in its coordinates."""
        import scipy.linalg

        A, b, c, _, _ = self._loop
        T, Z = scipy.linalg.schur(A, "complex")
        return T, c @ Z, Z.conj().T @ b

    @cached_property
    def loop(self) -> control.FrequencyResponseData:
        """Return the opened loop at `omega` as an object of python-control; `margins` also sees both ends."""
        need("control", "a system of python-control")
        import control

        return control.frd(self.at_frequencies(self.omega), self.omega, smooth=True)

    @cached_property
    def margins(self) -> Margins:
        """Compute the margins, with upper and lower gain margins; each of these gains has a pole on the unit circle.

        Raises
        ------
        RunError
            The loop closed over a gain margin has no pole on the unit circle: its matrices are too badly scaled.
        """
        omega, L = resolved(self.at_frequencies, self.omega)
        crossings = gain_crossings(self.at_frequencies, omega, L)
        turned = phase_crossings(self.at_frequencies, omega, L)
        gains = [*zip((1.0 / np.abs(self.at_frequencies(turned))).tolist(), self._points(turned), strict=True)]
        gains += self._ends()
        up = min((g for g in gains if g[0] > 1.0), default=(math.inf, 0j))
        down = max((g for g in gains if g[0] < 1.0), default=(0.0, 0j))
        for gain, z in (up, down):
            self._confirm(gain, z)
        # A delay only turns the curve clockwise, so the phase that may be lost is counted from 0 to 2 pi.
        lost = (np.angle(self.at_frequencies(crossings)) + np.pi) % (2.0 * np.pi)
        return Margins(
            up[0],
            down[0],
            float(np.min(lost, initial=np.inf)),
            float(np.min(lost / crossings, initial=np.inf)),
            # The disk margin of skew 0 is the inverse of the largest |S - 1/2|, where S = 1 / (1 + L) is the
            # sensitivity.
            float(1.0 / np.abs(1.0 / (1.0 + L) - 0.5).max()),
            float(np.max(crossings)) if crossings.size else np.nan,
        )

    def _points(self, omega: Array) -> list[complex]:
        result: list[complex] = np.exp(1j * omega * self.period).tolist()
        return result

    def _confirm(self, gain: float, z: complex) -> None:
        """Check that the loop with this gain has a pole at z, within the accuracy of the matrix."""
        A, b, c, d, _ = self._loop
        # A gain of zero or infinity stands for "no crossing", so there is no pole to look for.
        if not 0.0 < gain < math.inf or not len(b):
            return
        closed = A + gain / (1.0 - gain * d) * np.outer(b, c)
        apart = np.linalg.svd(z * np.eye(len(b)) - closed, compute_uv=False)[-1]
        if apart > ON_CIRCLE * (1.0 + np.linalg.norm(closed)):
            raise RunError(
                f"{self.rig}: the loop closed over a gain of {gain:.6g} has no pole on the unit circle, so that is no "
                "margin: its matrices are too badly scaled; use other units"
            )

    def _ends(self) -> list[tuple[float, complex]]:
        """Find the gains at which a pole crosses the unit circle at z = 1 or -1, where the loop is real without a
        crossing.
        """
        A, b, c, d, _ = self._loop
        result: list[tuple[float, complex]] = []
        for z in (1.0, -1.0):
            # The opened loop may have a pole there itself.
            with suppress(np.linalg.LinAlgError):
                terms = [*(c * np.linalg.solve(z * np.eye(len(b)) - A, b)).tolist(), d]
                back = math.fsum(terms)
                # A smaller sum is zero within rounding, and a larger one means a pole of the opened loop at z.
                if NOTHING * math.fsum(map(abs, terms)) < back < 1.0 / NOTHING:
                    result.append((1.0 / back, complex(z)))
        return result

    def plot(self) -> Any:
        """Draw Bode and Nyquist diagrams of the opened loop.

        Returns
        -------
        matplotlib.figure.Figure
        """
        from matplotlib.figure import Figure

        L, f = self.at_frequencies(self.omega), self.omega
        figure = Figure(figsize=(9.0, 4.5), layout="constrained")
        panes = figure.subplot_mosaic([["gain", "nyquist"], ["phase", "nyquist"]])
        panes["gain"].loglog(f, np.abs(L))
        panes["gain"].axhline(1.0, color="0.7", lw=0.8)
        panes["phase"].semilogx(f, np.degrees(np.unwrap(np.angle(L))))
        panes["gain"].set(ylabel="|L|")
        panes["phase"].set(xlabel="frequency (rad/s)", ylabel="phase (degrees)")
        panes["nyquist"].plot(L.real, L.imag, L.real, -L.imag, "C0:")
        panes["nyquist"].plot(-1.0, 0.0, "k+")
        panes["nyquist"].set(xlim=(-3, 1), ylim=(-2, 2), aspect="equal", xlabel="Re L", ylabel="Im L")
        state = "" if self.stable else ", unstable when closed"
        figure.suptitle(f"{self.rig}, opened at {self.link}, t = {self.at:g} s{state}")
        return figure


def linear_view(
    what: str | Scenario | Rig,
    link: str | None = None,
    *,
    at: float | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    duration: float | None = None,
    overrides: Mapping[str, Any] | None = None,
    seed: int | None = None,
) -> LinearView:
    """Linearise a rig around the state of a run.

    Parameters
    ----------
    what, duration, overrides
        See `rig_of`.
    link : str, optional
        Signal at which a loop is opened, by its own or a shared name; default: the only command value of the plants.
        If there are several, and with ``""``, no loop is opened.
    at : float, optional
        Time of the linearisation, s; default: the end of the scenario.
    inputs : sequence of str, optional
        Signals to which something is added; default: what sources (references, disturbances) publish at each period.
    outputs : sequence of str, optional
        Signals that are read; default: what the plants publish.
    seed : int, optional
        Seed of the rig.

    Raises
    ------
    ScenarioError
        No such signal; the rig's periods do not fit each other, or the period of the link is not that of the rig.
    RunError
        There is no loop at the link, the rig failed, its state cannot be restored, or there are too many states.
    """
    rig = rig_of(what, duration=duration, overrides=overrides)
    at = rig.scenario.duration if at is None else at
    if not (math.isfinite(at) and at >= 0.0):
        raise ScenarioError(f"at = {at:g} s: expected 0 or more")
    opened = _command(rig) if link is None else signal_of(rig, link) if link else ""
    named = [signal_of(rig, name) for name in outputs or ()]
    observed = named
    # The link does not depend on plants outside of its loop, so their states would only make the view larger.
    if opened and outputs is None:
        involved = upstream(place_of(rig, opened).member)
        observed = [s for s in plant_outputs(rig) if place_of(rig, s).member.name in involved]
    elif outputs is None:
        observed = plant_outputs(rig)
    messages = list(dict.fromkeys([*observed, *([opened] if opened else [])]))
    if not messages:
        raise ScenarioError(f"{rig.scenario.name}: no plant publishes at each of its ticks; name outputs")
    number = rig.scenario.seed_of(seed)
    driven = [signal_of(rig, name) for name in inputs] if inputs is not None else _source_inputs(rig, messages)
    result = StateMap(rig, at, number, messages, [*driven, *([opened] if opened else [])], FOLLOWED)
    if opened:
        _check_link(result, opened)
    view = Differences(result, observed, driven, opened).view()
    if lost := [name for name in named if name in view.left_out]:
        raise RunError(f"{rig.scenario.name}: {lost[0]} {view.left_out[lost[0]]}")
    return view


class LinearAlong(NamedTuple):
    r"""A rig, linear along its run: :math:`\delta x_{k+1} = A_k \delta x_k + B_k \delta u_k`, outputs by C and D.

    It also represents what one matrix cannot: a rig in motion, and outputs that turn with an angle.
    """

    rig: str
    """Name of the scenario."""

    at: float
    """When it begins, s."""

    period: float
    """Of the whole rig: from one k to the next, s."""

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    A: Array
    """Shape (periods, states, states)."""

    B: Array
    """Shape (periods, states, inputs)."""

    C: Array
    """Shape (periods, outputs, states)."""

    D: Array
    """Shape (periods, outputs, inputs)."""

    state_error: float
    """Largest difference of a state to the rig itself, moved off in all states, of the largest that any does, 1."""

    output_errors: dict[str, float]
    """The same of each output, of the largest that it does, 1."""

    def answer(self, inputs: Array) -> tuple[Array, Array]:
        """Return how states and outputs differ from the run when something is added to its inputs.

        Parameters
        ----------
        inputs : array, shape (periods, inputs)
            What is added over each period.

        Returns
        -------
        states : array, shape (periods, states)
            At the end of each period.
        outputs : array, shape (periods, outputs)
            At its beginning.
        """
        x, states, outputs = np.zeros(len(self.states)), [], []
        for A, B, C, D, u in zip(self.A, self.B, self.C, self.D, inputs, strict=True):
            outputs.append(C @ x + D @ u)
            x = A @ x + B @ u
            states.append(x)
        return np.array(states), np.array(outputs)


def linear_along(
    what: str | Scenario | Rig,
    periods: int = COMPARED_PERIODS,
    *,
    at: float | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    overrides: Mapping[str, Any] | None = None,
    seed: int | None = None,
) -> LinearAlong:
    """Linearise a rig at each period of a run, from a time on.

    Parameters
    ----------
    what, overrides
        See `rig_of`.
    periods : int
        Number of periods of the whole rig.
    at, inputs, outputs, seed
        See `linear_view`.

    Raises
    ------
    ScenarioError
        As `linear_view`, or less than one period.
    RunError
        The rig failed, its state cannot be restored, or there are too many states.
    """
    if periods < 1:
        raise ScenarioError(f"a view along {periods} periods: expected at least 1")
    rig = rig_of(what, overrides=overrides)
    at = max(0.0, rig.scenario.duration) if at is None else at
    if not (math.isfinite(at) and at >= 0.0):
        raise ScenarioError(f"at = {at:g} s: expected 0 or more")
    messages = [signal_of(rig, name) for name in outputs] if outputs is not None else plant_outputs(rig)
    if not messages:
        raise ScenarioError(f"{rig.scenario.name}: no plant publishes at each of its ticks; name outputs")
    driven = [signal_of(rig, name) for name in inputs] if inputs is not None else _source_inputs(rig, messages)
    number = rig.scenario.seed_of(seed)
    result = StateMap(rig, at, number, messages, driven, max(FOLLOWED, periods))
    return Differences(result, messages, driven, "").along(periods)


def _command(rig: Rig) -> str:
    """Return the only value that a plant is commanded; empty when there are several."""
    # A source without inputs (a disturbance) and another plant close no loop, so their links are not commands.
    commands = {
        f"{link.port.topic}/{label}": None
        for m in rig.members
        if m.is_plant
        for link in m.links.values()
        if link.source.links and not link.source.is_plant and not link.port.sporadic
        for label in link.port.labels
    }
    return next(iter(commands)) if len(commands) == 1 else ""


def plant_outputs(rig: Rig) -> list[str]:
    """Return the signals that plants publish at each of their ticks."""
    return [f"{p.topic}/{x}" for m in rig.members if m.is_plant for p in m.outputs if not p.sporadic for x in p.labels]


def _source_inputs(rig: Rig, texts: Sequence[str]) -> list[str]:
    """Return the sources' outputs to nodes with states, at least as often as those nodes are due."""
    involved: dict[str, Any] = {}
    for name in texts:
        upstream(place_of(rig, name).member, involved)
    every = math.lcm(*(m.schedule.every for m in involved.values() if not is_source(m)))
    return [
        f"{p.topic}/{x}"
        for m in rig.members
        # In a period without a tick of a slower source nothing could be added to its output, so B has no column for it.
        if m.name in involved and is_source(m) and every % m.schedule.every == 0
        for p in m.outputs
        if not p.sporadic
        for x in p.labels
    ]


def _check_link(result: StateMap, link: str) -> None:
    member, port, _ = result.places[link]
    if port.sporadic:
        raise ScenarioError(f"{result.rig.scenario.name}: {link} is not published at each tick: it cannot be opened")
    # With several messages in one period there is no single value at which the loop could be opened.
    if member.params.period < result.period * (1.0 - 1e-9):
        slow = [
            f"{p.topic}/{x}"
            for name in result.step_names()
            for m in result.rig.members
            if m.name == name and not is_source(m) and m.params.period > result.period * (1.0 - 1e-9)
            for p in m.outputs
            if not p.sporadic
            for x in p.labels
        ]
        raise ScenarioError(
            f"{result.rig.scenario.name}: {link} is published every {member.params.period:g} s, but the rig repeats "
            f"only every {result.period:g} s; open the loop where it is slow: {', '.join(slow) or 'no such link'}, or "
            "give all the same period by --set"
        )


class Differences:
    """The columns of a rig's linear map, found by moving its states: those that move in the run, and those that they
    move.
    """

    def __init__(self, state_map: StateMap, outputs: Sequence[str], inputs: Sequence[str], link: str) -> None:
        self.map, self.outputs, self.inputs, self.link = state_map, list(outputs), list(inputs), link
        self.published = self._begin()
        self.fixed = {link: self.published[link]} if link else {}
        self.measured = [*outputs, *([link] if link else [])]
        # A limit that is not set is infinite, and infinity cannot be moved.
        self.finite = np.isfinite(state_map.start)
        self.columns: dict[int | str, tuple[Array, Array]] = {}  # numbers by place, and signals by name
        self.errors: dict[int | str, float] = {}
        self.steps: dict[int | str, float] = {}

    def _begin(self) -> dict[str, float]:
        """Return the outputs at the map's current `start`, and store the parts of the state that are not floats."""
        _, outputs = self.map(self.map.start, {})
        self.others = self.map.others()
        return outputs

    def states(self) -> tuple[list[int], Array, Array]:
        """Return the places of the states that the outputs depend on, A, and the rows of the outputs."""
        if self.link:
            self._find(self.link)
        self._explore()
        if self.link and not self._loops():
            raise RunError(f"{self.map.rig.scenario.name}: {self._no_loop()}")
        for name in self.inputs:
            self._find(name)
        self._explore()
        on = self._on()
        full = self._square(on)
        received = np.array([self.columns[i][1] for i in on]).T.reshape(len(self.measured), len(on))
        counts = _reach(full.T, (received != 0.0).any(axis=0))
        # A value that nothing moves acts like a parameter here.
        constant = (full == np.eye(len(on))).all(axis=1)
        # So is a plant's copy of its command, which is replaced in each period.
        constant |= self.map.resting[on] & (full == 0.0).all(axis=1)
        for key, (column, _) in self.columns.items():
            if isinstance(key, str):
                constant &= column[on] == 0.0
        counts &= ~constant
        kept = [i for i, counted in zip(on, counts, strict=True) if counted]
        if len(kept) > MOST:
            self._too_many(kept)
        return kept, full[np.ix_(counts, counts)], received[:, counts]

    def _explore(self) -> None:
        """Find the columns of the states that have moved in the run, that rest in a plant, or that a known column
        affects.
        """
        waiting = {int(i) for i in np.flatnonzero((self.map.moved | self.map.resting) & self.finite)}
        waiting |= {int(i) for column, _ in self.columns.values() for i in np.flatnonzero(column)}
        waiting -= self.columns.keys()
        # A state at zero gets its size from the columns of others; its new column may then give a size to further
        # states.
        for _ in range(ROUNDS + 1):
            while waiting:
                if len(waiting) + len(self.columns) > TRIED:
                    self._too_many([*waiting, *self._on()])
                i = waiting.pop()
                self._find(i)
                waiting |= {int(j) for j in np.flatnonzero(self.columns[i][0])} - self.columns.keys()
            waiting = self._dwarfed()

    def _on(self) -> list[int]:
        return sorted(i for i in self.columns if isinstance(i, int))

    def _loops(self) -> bool:
        """Return whether the link depends on itself, according to the columns."""
        on, (column, direct) = self._on(), self.columns[self.link]
        c = np.array([self.columns[i][1][-1] for i in on])
        return bool(direct[-1] or _between(self._square(on), column[on], c).any())

    def _dwarfed(self) -> set[int]:
        """Return the states that were moved much less than others move them; a state at zero has no size of its own."""
        sizes = self.map.sizes
        natural = np.zeros(len(sizes))
        for key, (column, _) in self.columns.items():
            natural = np.maximum(natural, np.abs(column) * (sizes[key] if isinstance(key, int) else 1.0))
        result = {i for i in self.columns if isinstance(i, int) and sizes[i] < natural[i] / 64.0}
        for i in result:
            sizes[i] = natural[i]
        return result

    def again(self, kept: list[int]) -> Array:
        """Return A at the present `start` of the map."""
        self._begin()
        for i in kept:
            self._find(i)
        return self._square(kept)

    def _square(self, on: list[int]) -> Array:
        return np.array([self.columns[i][0][on] for i in on]).T.reshape(len(on), len(on))

    def _too_many(self, indices: list[int]) -> NoReturn:
        counts = Counter(self.map.names[i].partition("[")[0] for i in indices)
        name, most = counts.most_common(1)[0]
        raise RunError(
            f"{self.map.rig.scenario.name}: {len(indices)} numbers move, {most} of them in {name}, expected at most "
            f"{MOST} states: a long delay has one or more for each of its steps; choose longer steps by --set"
        )

    def view(self) -> LinearView:
        """Assemble the linear view."""
        m = self.map
        kept, A, C = self.states()
        B = np.array([self.columns[n][0][kept] for n in self.inputs]).T.reshape(len(kept), len(self.inputs))
        D = np.array([self.columns[n][1] for n in self.inputs]).T.reshape(len(self.measured), len(self.inputs))
        a, b, c, d = A, np.zeros(len(kept)), np.zeros(len(kept)), 0.0
        if self.link:
            column, direct = self.columns[self.link]
            b, c, d = column[kept], C[-1], float(direct[-1])
            # The rig is the opened loop closed by v = s, where d is the direct way around it.
            A = a + np.outer(b, c) / (1.0 - d)
            B = B + np.outer(b, D[-1]) / (1.0 - d)
            C, D = C + np.outer(direct, c) / (1.0 - d), D + np.outer(direct, D[-1]) / (1.0 - d)
        rows = len(self.outputs)
        judged = _between(a, b, c) if self.link else np.ones(len(kept), bool)
        runs = self._apart(kept, COMPARED_PERIODS)
        apart, received = (
            self._compared(kept, runs, repeat((A, C[:rows])), judged, CHECKED) if kept else (0.0, [0.0] * rows)
        )
        reasons = self._left_out(kept, A, C[:rows], apart, received)
        on = [k for k, name in enumerate(self.outputs) if name not in reasons]
        names = [m.names[i] for i in kept]
        used: list[int | str] = [*kept, *self.inputs, *([self.link] if self.link else [])]
        worst = max(used, key=lambda key: self.errors[key], default="")
        units = signal_units(m.rig)
        values = dict(zip(names, m.start[kept].tolist(), strict=True)) | self.published
        return LinearView(
            m.rig.scenario.name, m.t, m.period, tuple(names), tuple(self.inputs), tuple(self.outputs[k] for k in on),
            {s: units.get(s, "") for s in m.places}, values, A, B, C[on], D[on], self.link, a, b, c, d,
            self.errors.get(worst, 0.0), m.names[worst] if isinstance(worst, int) else worst, apart,
            {self.outputs[k]: received[k] for k in on}, reasons,
        )  # fmt: skip

    def _no_loop(self) -> str:
        """Describe why a small change at the link does not return to it."""
        m, link = self.map, self.link
        member, port, _ = m.places[link]
        readers = {
            r.name
            for r in upstream(member).values()
            for k in r.links.values()
            if (k.source.name, k.port.name) == (member.name, port.name)
        }
        if not readers:
            return f"{member.name} does not depend on {link}: no loop"
        size = _power(abs(self.published[link]) or 1.0)

        def back(height: float) -> list[float]:
            return [outputs[link] for _, outputs in m.go_on(m.start, CHECKED, {link: height}, self.fixed)]

        begun, after = back(0.0), f"at {m.t:g} s, within {CHECKED} periods"
        # The search begins with the smallest step, so the message names the smallest change that comes back.
        for n in range(-20, 4):
            # A step that is too large leaves a limit or a domain.
            with suppress(RunError):
                if any(back(sign * size * 2.0**n) != begun for sign in (1.0, -1.0)):
                    return (
                        f"a change of {link} by {size * 2.0**n:.3g} comes back there {after}, a smaller one does "
                        "not: on the way something goes in steps (a quantised sensor, a switch, a search), and "
                        "that has no linear view; remove the steps, or choose another link"
                    )
        return f"no change of {link} comes back there {after}: on the way something is at a limit, or waits"

    def _moved(self, key: int | str, height: float) -> tuple[Array, dict[str, float]]:
        """Return what the map gets when a number of its start, or a signal, is moved."""
        if isinstance(key, str):
            return self.map.start, {key: height}
        start = self.map.start.copy()
        start[key] += height
        return start, {}

    def _parted(self, numbers: Array, added: Mapping[str, float]) -> str:
        """Name a value that is not a float, changes with the moved value, and has an effect; empty if there is none."""
        now, before = self.map.others(), self.others
        if now == before:
            return ""
        name = next((new for (new, x), (_, y) in zip(now, before, strict=False) if x != y), (now + before)[-1][0])
        return name if self.map.follows(numbers, added, self.fixed) else ""

    def _find(self, key: int | str) -> None:
        """Find the column of a number of the start, or of a signal, and the step that fits it."""
        m, fixed = self.map, self.fixed
        if isinstance(key, str) and math.isnan(self.published[key]):
            raise RunError(f"{m.rig.scenario.name}: {key} is not published at {m.t:g} s, so no offset can be added")
        size = _power(abs(self.published[key] if isinstance(key, str) else float(m.sizes[key])) or 1.0)

        def shifted(height: float) -> tuple[Array, Array, float, str]:
            start, added = self._moved(key, height)
            x, outputs = m(start, added, fixed)
            width = height if isinstance(key, str) else float(start[key] - m.start[key])
            return x, np.array([outputs[s] for s in self.measured]), width, self._parted(start, added)

        best: tuple[float, tuple[Array, Array], float] | None = None
        before: tuple[Array, Array] | None = None
        stepping = ""
        for share in STEPS:
            try:
                up, down = shifted(size * share), shifted(-size * share)
            # The step leaves a limit or the domain of a block; smaller ones may not.
            except RunError:
                before = None
                continue
            # This step is too large as well: no column would show effects that pass through values that are not floats.
            if parted := up[3] or down[3]:
                before, stepping = None, parted
                continue
            width = up[2] - down[2]
            # The step is lost in the rounding of a large number, and so are all smaller ones.
            if not width:
                break
            apart_by = np.subtract(up[0], down[0], out=np.zeros(len(up[0])), where=self.finite)
            now = apart_by / width, (up[1] - down[1]) / width
            if before is not None:
                largest = max(np.abs(now[0]).max(initial=0.0), np.abs(now[1]).max(initial=0.0))
                apart = max(np.abs(now[0] - before[0]).max(initial=0.0), np.abs(now[1] - before[1]).max(initial=0.0))
                error = float(apart / largest) if largest else float(apart)
                if best is None or error < best[0]:
                    # Where two steps agree to rounding the map is linear, and the larger step has the smaller rounding
                    # error.
                    best = error, before if error <= AGREED else now, size * share
                if error <= AGREED:
                    break
            before = now
        if best is None:
            name, rig = m.names[key] if isinstance(key, int) else key, m.rig.scenario.name
            if stepping:
                raise RunError(
                    f"{rig}: {stepping} changes with {name} at {m.t:g} s, however little that is disturbed, and "
                    "is not a float: whole numbers, texts and switches cannot be linearised, so their effect would be "
                    "missing; keep it as a float"
                )
            raise RunError(f"{rig}: {name} cannot be disturbed at {m.t:g} s, however little")
        self.errors[key], self.columns[key], self.steps[key] = best

    def _off(self, kept: list[int]) -> Array:
        """Return the offset of each state for the check in which all states are moved together."""
        signs = np.where(np.arange(len(kept)) % 3 == 1, -1.0, 1.0)
        return signs * np.array([self.steps[i] for i in kept]) * NEARER

    def _apart(self, kept: list[int], periods: int, times: float = 1.0) -> Iterator[tuple[Array, Array]]:
        """Yield half the difference of two runs with opposite offsets, in each period: of the states after it, of the
        outputs before it.
        """
        m, off = self.map, times * self._off(kept)
        courses = []
        # The half difference of two opposite offsets cancels the even terms, so a curvature does not count as an error.
        for sign in (1.0, -1.0):
            start = m.start.copy()
            start[kept] += sign * off
            courses.append(
                [(x[kept], np.array([outputs[s] for s in self.outputs])) for x, outputs in m.go_on(start, periods)]
            )
        for (up, heard_up), (down, heard_down) in zip(*courses, strict=True):
            yield 0.5 * (up - down), 0.5 * (heard_up - heard_down)

    def _compared(
        self, kept: list[int], runs: Iterable[tuple[Array, Array]], matrices: Iterable[Any], judged: Any, until: int
    ) -> tuple[float, list[float]]:
        """Compare the linear model with the rig when all states are moved together, in both directions.

        Parameters
        ----------
        runs : iterable of (array, array)
            See `_apart`.
        matrices : iterable of (array, array)
            A and the rows of the outputs in each period.
        judged : index
            Which states count, in the first `until` periods.
        """
        off, sizes = self._off(kept), self._sizes(kept)
        worst = largest = 0.0
        simulated, predicted = [], []
        for k, ((moved, received), (A, C)) in enumerate(zip(runs, matrices, strict=False)):
            simulated.append(received)
            predicted.append(C @ off)
            off = A @ off
            if k < until:
                worst = max(worst, float(np.abs((moved - off) / sizes)[judged].max(initial=0.0)))
                largest = max(largest, float(np.abs(moved / sizes)[judged].max(initial=0.0)))
        return worst / largest if largest else 0.0, shares(np.array(simulated), np.array(predicted))

    def _sizes(self, kept: list[int]) -> Array:
        m = self.map
        sizes = np.maximum(m.sizes[kept], 1e-300)
        sizes[m.sizes[kept] == 0.0] = 1.0
        return sizes

    def _left_out(self, kept: list[int], A: Array, C: Array, apart: float, received: Sequence[float]) -> dict[str, str]:
        """Return the outputs that are not functions of the states, with the reason."""
        far = {k: error for k, error in enumerate(received) if error > max(LEFT_OUT, 100.0 * apart)}
        result = {}
        if quiet := [k for k, error in enumerate(received) if not error and not C[k].any()] if kept else []:
            # An output that counts or is quantised changes only with a large move, so the states are moved by the whole
            # steps of their columns.
            late = np.zeros(len(received), bool)
            # The rig may break so far off.
            with suppress(RunError):
                far_off = self._apart(kept, FOLLOWED - LATER - 1, 1.0 / NEARER)
                late = np.array([y for _, y in far_off]).any(axis=0)
            why = "goes in steps (counts, a quantised sensor) or belongs to other ticks: the states act later"
            result = {self.outputs[k]: why for k in quiet if late[k]}
        if not far:
            return result
        moved = np.array([y for _, y in self._apart(kept, COMPARED_PERIODS)])
        linear, off = [], self._off(kept)
        t, start = self.map.t, self.map
        for _ in range(LATER + 1):
            linear.append(self.rows(kept)[1] @ off)
            off = A @ off
            # An output that turns with an angle has another row at each tick, so the rows are taken along the run.
            start.advance()
        turning = shares(moved[: LATER + 1], np.array(linear))
        for k, error in far.items():
            silent = not C[k].any()
            if turning[k] <= LEFT_OUT and not (silent and not np.any(linear, axis=0)[k]):
                why = "is another function of the states at each tick (it turns with an angle, or the run moves on)"
                why += "; a view along the run carries it: --along"
            elif silent:
                why = "follows from no small move at that tick: it belongs to other ticks, counts or goes in steps"
            else:
                why = "is not smooth: it goes in steps, or belongs to other ticks too"
            result[self.outputs[k]] = (
                f"{why}; off by {100.0 * error:.3g} % within {COMPARED_PERIODS} periods from {t:.6g} s"
            )
        return result

    def rows(self, kept: list[int]) -> tuple[Array, Array]:
        """Return A and the rows of the outputs at the map's current `start`, with the known step sizes."""
        self._begin()
        return self._slopes(kept, kept)

    def _slopes(self, keys: Sequence[int | str], kept: list[int]) -> tuple[Array, Array]:
        """Return columns of the states and of the outputs at the map's current `start`, with the known step sizes."""
        columns = []
        for key in keys:
            # A new search over all step sizes would take up to eight times as many runs for each column and period.
            up, down = (self.map(*self._moved(key, sign * self.steps[key]), self.fixed) for sign in (1.0, -1.0))
            y = np.array([up[1][s] - down[1][s] for s in self.outputs])
            columns.append([part / (2.0 * self.steps[key]) for part in (up[0][kept] - down[0][kept], y)])
        x, y = (
            np.array([c[k] for c in columns]).T.reshape(n, len(keys))
            for k, n in enumerate((len(kept), len(self.outputs)))
        )
        return x, y

    def along(self, periods: int) -> LinearAlong:
        """Find A, B, C and D at each of some periods, and compare the linear model with the rig."""
        m, t = self.map, self.map.t
        kept = self._reached(self.states()[0], periods)
        if not kept:
            raise RunError(f"{m.rig.scenario.name}: no output depends on a state at {t:g} s")
        runs, results = list(self._apart(kept, periods)), []
        for k in range(periods):
            if k:
                m.advance()
            (A, C), (B, D) = self.rows(kept), self._slopes(self.inputs, kept)
            results.append((A, B, C, D))
        apart, errors = self._compared(kept, runs, [(A, C) for A, _, C, _ in results], slice(None), periods)
        A, B, C, D = (np.array(part) for part in zip(*results, strict=True))
        return LinearAlong(
            m.rig.scenario.name,
            t,
            m.period,
            tuple(m.names[i] for i in kept),
            tuple(self.inputs),
            tuple(self.outputs),
            A,
            B,
            C,
            D,
            apart,
            dict(zip(self.outputs, errors, strict=True)),
        )

    def _reached(self, kept: list[int], periods: int) -> list[int]:
        """Return these states and all that they move later, such as the places of a ring that another tick reads."""
        m, reached = self.map, set(kept)
        while True:
            off = np.zeros(len(m.start))
            off[sorted(reached)] = self._off(sorted(reached))
            ups, downs = ([x for x, _ in m.go_on(m.start + shift, periods)] for shift in (off, -off))
            moved = np.any([up != down for up, down in zip(ups, downs, strict=True)], axis=0)
            new = {int(i) for i in np.flatnonzero(moved & self.finite)} - reached
            # A state that no output depends on at the first period may be moved by others later, so the set grows until
            # nothing new moves.
            if not new:
                return sorted(reached)
            for i in new - self.columns.keys():
                self._find(i)
            reached |= new
            if len(reached) > MOST:
                self._too_many(sorted(reached))


def shares(actual: Array, values: Array) -> list[float]:
    """Return the largest difference of two courses of each output, relative to the largest value of both."""
    apart, largest = np.abs(actual - values).max(axis=0), np.maximum(np.abs(actual), np.abs(values)).max(axis=0)
    return (apart / np.where(largest > 0.0, largest, 1.0)).tolist()  # type: ignore[no-any-return]


def _power(size: float) -> float:
    """Return the power of two nearest to a size; adding it to a state usually needs no rounding."""
    return float(2.0 ** round(math.log2(size)))


def _reach(A: Array, start: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the states that some states affect, directly or through others (nonzero entries of A)."""
    reached, links = start.copy(), A != 0.0
    while True:
        wider = reached | links[:, reached].any(axis=1)
        if (wider == reached).all():
            return reached
        reached = wider


def _between(A: Array, b: Array, c: Array) -> NDArray[np.bool_]:
    """Return the states that depend on an input and affect an output."""
    return _reach(A, b != 0.0) & _reach(A.T, c != 0.0)
