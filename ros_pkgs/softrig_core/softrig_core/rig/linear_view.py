r"""The linear view of any loop of a rig: what comes back to a link when a pulse is added there.

A rig is a deterministic map: two runs that differ by a small pulse on one signal differ by the loop's response to it,
whatever the blocks keep as state (histories, messages under way, filters). With :math:`G` the response of what is said
to what is added,

.. math:: S = 1 + G, \quad L = -G / (1 + G)

are the sensitivity and the loop opened there, of negative feedback.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import RunError, ScenarioError, closest
from ..model.port import Port, Sample
from ..model.runner import Runner
from ..model.step import Step
from ..timebase import SECOND
from ..wire.signals import full_name
from .inprocess import wired
from .members import Member, signal_units
from .requirements import names_of
from .rig import Rig
from .scenario import Scenario
from .simulate import rig_of, simulate

if TYPE_CHECKING:
    import control

Array = NDArray[np.float64]
STEPS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # heights of the pulse tried, relative to the signal
TAIL = 1e-4  # of the largest answer: what may be left of it at the end of the window
POINTS = 1000  # frequencies
LARGEST_ORDER = 40


class Margins(NamedTuple):
    """How far a loop is from instability; infinite where nothing crosses."""

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


@dataclass(frozen=True)
class LinearView:
    """A loop of a rig, linear around where a run is.

    Parameters
    ----------
    rig : str
        Name of the scenario.
    signal : str
        Where the loop is opened.
    unit : str
    at : float
        When the pulse came, s.
    period : float
        Of who says the signal, s.
    value : float
        Of the signal there.
    response : array, shape (samples,)
        G: what is said after a pulse of one unit at sample 0.
    step : float
        Height of the pulse, in `unit`.
    error : float
        Largest difference between the responses to this pulse and to the neighbouring height, of the largest answer.
    variation : float
        Largest difference between the responses to a pulse here and one period later, of the largest answer: a loop
        that is no other each tick has none.
    """

    rig: str
    signal: str
    unit: str
    at: float
    period: float
    value: float
    response: Array
    step: float
    error: float
    variation: float

    @cached_property
    def omega(self) -> Array:
        """Frequencies up to that of Nyquist, rad/s."""
        top = np.pi / self.period
        return np.geomspace(np.pi / (len(self.response) * self.period), top * (1.0 - 1e-9), POINTS)

    def at_frequencies(self, omega: Array) -> NDArray[np.complex128]:
        """Give the opened loop L(exp(j omega T)) by the sum of the response.

        Parameters
        ----------
        omega : array, shape (n,)
            rad/s.
        """
        samples = np.arange(len(self.response))
        G: Any = np.array([np.dot(self.response, np.exp(-1j * w * self.period * samples)) for w in omega])
        L: NDArray[np.complex128] = -G / (1.0 + G)
        return L

    @cached_property
    def loop(self) -> control.FrequencyResponseData:
        """Give the opened loop at `omega`, of the python-control library."""
        import control

        return control.frd(self.at_frequencies(self.omega), self.omega, smooth=True)

    @cached_property
    def margins(self) -> Margins:
        """Measure the margins by python-control; that of the disk on the frequencies alone."""
        import control

        gains, phases, _, _, crossings, _ = control.stability_margins(self.loop, returnall=True)
        gains, crossings = np.atleast_1d(gains), np.atleast_1d(crossings)
        lost = np.radians(np.atleast_1d(phases)) % (2.0 * np.pi)  # all crossings turn towards -1 with a delay
        up, down = gains[gains > 1.0], gains[gains < 1.0]
        S = 1.0 / (1.0 + self.at_frequencies(self.omega))
        return Margins(
            float(up.min(initial=np.inf)), float(down.max(initial=0.0)), float(lost.min(initial=np.inf)),
            float((lost / crossings).min(initial=np.inf)) if crossings.size else np.inf,
            float(1.0 / np.abs(S - 0.5).max()), float(crossings.max()) if crossings.size else np.nan,
        )  # fmt: skip

    @cached_property
    def closed(self) -> control.StateSpace:
        """Realise the response from what is added at the link to what is said there: the rig's discrete state space.

        Its states are those that the link moves and hears of, in coordinates of their own (Ho and Kalman 1966, by
        singular values of a Hankel matrix of samples), at the least order
        that gives the response as well as it is known.
        """
        import control

        g, count = self.response[1:], len(self.response) - 1
        half = count // 2 - 1
        index = np.unique(np.concatenate([np.arange(min(60, half)), np.geomspace(1, half, 100).astype(int)]))
        sums = index[:, None] + index[None, :]
        H0, H1 = g[sums], g[sums + 1]
        U, s, Vt = np.linalg.svd(H0)
        most = int(min(LARGEST_ORDER, (s > 1e-13 * s[0]).sum()))
        aim = max(1e-9, self.error) * np.abs(g).max()
        best: tuple[float, Any] = (np.inf, None)
        for n in range(1, most + 1):
            root = np.sqrt(s[:n])
            A = (U[:, :n] / root).T @ H1 @ (Vt[:n].T / root)
            B, C = root * Vt[:n, 0], U[0, :n] * root
            x, worst = B, 0.0
            for value in g[: min(count, 2000)]:
                worst = max(worst, abs(float(C @ x) - value))
                x = A @ x
                if not worst < 10.0 * best[0] or not np.isfinite(worst):
                    break
            else:
                if worst < best[0]:
                    best = worst, (A, B, C)
                if worst <= aim:
                    break
        A, B, C = best[1]
        return control.ss(A, B[:, None], C[None, :], 0.0, self.period)

    @cached_property
    def opened(self) -> control.StateSpace:
        """Give the loop opened at the link as a state space, by closing `closed` once more: -G / (1 + G)."""
        import control

        return -control.feedback(self.closed, 1.0)

    @property
    def misfit(self) -> float:
        """How far the response of `closed` is from that of the rig, of the largest answer."""
        import control

        _, y = control.impulse_response(self.closed, np.arange(len(self.response)) * self.period)
        return float(np.abs(y * self.period - self.response).max() / np.abs(self.response).max())

    def plot(self) -> Any:
        """Draw Bode and Nyquist diagrams.

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
        figure.suptitle(f"{self.rig}, opened at {self.signal}, t = {self.at:g} s")
        return figure


def linear_view(
    what: str | Scenario | Rig, link: str = "", *, at: float | None = None, window: float | None = None,
    duration: float | None = None, overrides: Mapping[str, Any] | None = None, seed: int | None = None,
) -> LinearView:  # fmt: skip
    """Linearise a rig where a run of it is, with the loop opened at a link.

    Parameters
    ----------
    what, duration, overrides
        See `rig_of`.
    link : str
        Signal by its own or a shared name; default: the only value that a plant is commanded.
    at : float, optional
        When, s; default: the end of the scenario.
    window : float, optional
        How long the answer is listened to, s; it must have died away. Default: the scenario's duration.
    seed : int, optional
        Of the rig.

    Raises
    ------
    ScenarioError
        No such link, or several without a name.
    RunError
        Nothing comes back, the answer does not die away, or the rig broke.
    """
    rig = rig_of(what, duration=duration, overrides=overrides)
    at = rig.scenario.duration if at is None else at
    window = rig.scenario.duration if window is None else window
    if not (at >= 0.0 and window > 0.0):
        raise ScenarioError(f"at = {at:g} s, window = {window:g} s: expected 0 or more, and more than 0")
    rig = rig.changed(duration=at + window)
    signal = _signal(rig, link)
    member, port, k = _place(rig, signal)
    number = rig.scenario.seed if seed is None else seed
    blocks = {m.name: m.block(number) for m in rig.members}

    def said(pulse: float, late: int = 0) -> Array:
        for block in blocks.values():
            block.reset(number)
        steps = wired(rig, blocks)
        probe = _Probe(steps[member.name], port, k, tick + late, pulse)
        for _ in Runner(list(steps.values())).run():
            pass
        return np.array(probe.said)

    tick = _tick(member, at)
    nominal = said(0.0)
    size = float(np.abs(nominal).max()) or 1.0  # in the whole run: where it rests it may be next to nothing
    nominal = nominal[tick:]
    if len(nominal) < 20:
        raise ScenarioError(
            f"{member.name} has {len(nominal)} ticks in the window of {window:g} s, expected 20 or more"
        )

    def response(height: float, late: int = 0) -> Array:
        return (said(height, late) - said(-height, late))[tick + late :] / (2.0 * height)

    found = [response(size * step) for step in STEPS]
    largest = [float(np.abs(g).max()) for g in found]
    apart = [_apart(a, b, max(m, n)) for a, b, m, n in zip(found, found[1:], largest, largest[1:])]
    best = int(np.argmin(apart))
    g, step = found[best + 1], size * STEPS[best + 1]
    if largest[best + 1] == 0.0:
        raise RunError(f"{rig.scenario.name}: what is added to {signal} at {at:g} s does not come back there: no loop")
    tail = float(np.abs(g[-max(2, len(g) // 20) :]).max()) / largest[best + 1]
    if not tail <= TAIL:
        raise RunError(f"{rig.scenario.name}: {window:g} s after a pulse on {signal} {tail:.2g} of the largest answer "
                       f"is left, expected {TAIL:g}: the loop is unstable, or a longer window is needed")  # fmt: skip
    later = response(step, 1)
    varies = _apart(g[: len(later)], later, largest[best + 1])
    unit = signal_units(rig).get(signal, "")
    return LinearView(rig.scenario.name, signal, unit, tick * member.schedule.every * rig.clock.params.period,
                      float(member.params.period), float(nominal[0]), g, step, apart[best], varies)  # fmt: skip


def _apart(a: Array, b: Array, size: float) -> float:
    return float(np.abs(a - b).max() / size) if size else np.inf


def _tick(member: Member, at: float) -> int:
    """Number of a member's first tick not before a time."""
    tick = max(0, int(at / member.params.period) - 1)
    while member.schedule.time(tick) < round(at * SECOND):
        tick += 1
    return tick


class _Probe:
    """Listens to a value of an output, and adds a pulse to what others get of it at one tick."""

    def __init__(self, step: Step, port: Port, k: int, tick: int, pulse: float) -> None:
        self.said: list[float] = []
        respond = step.respond

        def probed(t: int, **inputs: Any) -> Any:
            found = respond(t, **inputs)
            row: Any = found[port.name]
            data = tuple(row.data if isinstance(row, Sample) else row)
            here = len(self.said) == tick
            self.said.append(data[k])
            if not (here and pulse):
                return found
            data = (*data[:k], data[k] + pulse, *data[k + 1 :])
            return {**found, port.name: Sample(row.stamp, data) if isinstance(row, Sample) else data}

        step.respond = probed


def _signal(rig: Rig, link: str) -> str:
    """Give the whole name of the signal at which the loop is opened."""
    known = {f"{p.topic}/{label}" for m in rig.members for p in m.outputs for label in p.labels}
    if link:
        shared = names_of(rig, signal_units(rig))[1]
        found = full_name(shared.get(link, link), known)
        if found not in known:
            raise ScenarioError(f"{rig.scenario.name}: no signal {link!r}{closest(link, [*known, *shared])}")
        return found
    commands = {
        f"{link_.port.topic}/{label}": None
        for m in rig.members if m.is_plant
        for link_ in m.links.values() if link_.source.links and not link_.source.is_plant
        for label in link_.port.labels
    }  # fmt: skip
    if len(commands) != 1:
        raise ScenarioError(
            f"{rig.scenario.name}: open which link? The plants are commanded {', '.join(commands) or 'nothing'}"
        )
    return next(iter(commands))


def _place(rig: Rig, signal: str) -> tuple[Member, Port, int]:
    for member in rig.members:
        for port in member.outputs:
            for k, label in enumerate(port.labels):
                if f"{port.topic}/{label}" == signal:
                    if port.sporadic:
                        raise ScenarioError(
                            f"{rig.scenario.name}: {signal} is not said at each tick: it cannot be opened"
                        )
                    return member, port, k
    raise AssertionError(signal)


@dataclass(frozen=True)
class Rest:
    """Where a signal is at the end of a run.

    Parameters
    ----------
    mean : float
        Over the window.
    swing : float
        Largest less smallest value over the window.
    drift : float
        Mean of the window's second half less that of the first.
    unit : str
    """

    mean: float
    swing: float
    drift: float
    unit: str

    def rests(self, tolerance: float) -> bool:
        """Whether it moves no more than a share of its size, or of one unit where it is smaller."""
        return self.swing <= tolerance * max(1.0, abs(self.mean))


def steady(
    what: str | Scenario | Rig, *, at: float | None = None, window: float | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> dict[str, Rest]:  # fmt: skip
    """Say where each signal of a rig is at the end of a run: its operating point.

    Parameters
    ----------
    what, overrides
        See `rig_of`.
    at : float, optional
        End of the run, s; default: the scenario's.
    window : float, optional
        Over which it is looked at, s; default: the last tenth.

    Raises
    ------
    ScenarioError
        The window is not within the run.
    """
    run = simulate(what, duration=at, overrides=overrides)
    end = run.rig.scenario.duration
    window = 0.1 * end if window is None else window
    if not 0.0 < window <= end:
        raise ScenarioError(f"window = {window:g} s: expected more than 0, at most the run's {end:g} s")
    units, found = signal_units(run.rig), {}
    for name, (t, x) in run.signals.items():
        if not len(x):
            continue
        begin = max(int(np.searchsorted(t, end - window)) - 1, 0)  # also the value that holds as it begins
        part = x[begin:]
        half = max(1, len(part) // 2)
        drift = float(part[-half:].mean() - part[:half].mean())
        found[name] = Rest(float(part.mean()), float(np.ptp(part)), drift, units.get(name, ""))
    return found
