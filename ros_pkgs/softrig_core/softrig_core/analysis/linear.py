r"""Equilibria and linearisation of a model written once.

.. math:: \dot x = f(x, u), \quad y = g(x, u)

A model is a casadi function ``(x, u) -> (dx, y)``, whose Jacobians are exact, or a Python function of two float64
arrays with the same result, whose Jacobians are differences of order 4. `Sampled` makes such a model of any plant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..arrays import Array
from ..errors import RunError
from ..extras import need
from ..kit.dense import solve
from ..kit.floats import numbers, put, split

if TYPE_CHECKING:
    import control

    from ..block.block import Plant

STEP = 1e-3  # relative step of the differences: their error is of order STEP^4, their rounding of 1e-16/STEP


class Linear(NamedTuple):
    r"""A linear model around an operating point, :math:`\delta\dot x = A \delta x + B \delta u`, y with C and D."""

    A: Array
    """(states, states)"""

    B: Array
    """(states, inputs)"""

    C: Array
    """(outputs, states)"""

    D: Array
    """(outputs, inputs)"""

    x: Array
    """State of the operating point."""

    u: Array
    """Inputs there."""

    y: Array
    """Outputs there."""

    period: float = 0.0
    """s; of a model of differences: x of the next period in place of dx. 0: a model of derivatives."""

    def system(self, **names: Sequence[str]) -> control.StateSpace:
        """Return the model as a system of the python-control library, for poles, margins, Bode and step plots.

        Parameters
        ----------
        **names
            ``states``, ``inputs``, ``outputs``: sequences of names.
        """
        need("control", "a system of python-control")
        import control

        return control.ss(self.A, self.B, self.C, self.D, self.period, **names)


class Sampled:
    r"""One period of a plant as a model, :math:`dx = (x_{k+1} - x_k)/T`, inputs held: it rests where the plant rests.

    Parameters
    ----------
    plant : Plant
        Only its methods are called; a run that uses the plant is not affected.
    t : int
        When the period begins, ns.

    Notes
    -----
    x are the float fields of the plant's state; u are the values of its inputs, y those of its outputs that are not
    sporadic, in the order of its ports. Outputs behind an encoder change in steps, so their rows of C are meaningless.
    """

    def __init__(self, plant: Plant, t: int = 0) -> None:
        inputs, outputs = plant.ports(plant.p)
        self.plant, self.t = plant, t
        self.period = float(plant.p.period)
        self.inputs = inputs
        self.outputs = [port for port in outputs if not port.sporadic]

    def __call__(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Return (dx, y)."""
        # Only the float fields come from x; other fields of the state (counters, flags) keep their first values.
        first = self.plant.first()
        now = put(first, split(first, x))
        inputs, k = {}, 0
        for port in self.inputs:
            inputs[port.name] = tuple(u[k : k + port.size].tolist())
            k += port.size
        outputs = self.plant.outputs(now, self.t)
        y = [value for port in self.outputs for value in outputs[port.name]]
        after = numbers(self.plant.advance(now, self.t, **inputs))
        return (after - x) / self.period, np.array(y, dtype=float)

    def linearise(self, x: Sequence[float], u: Sequence[float]) -> Linear:
        r"""Linearise the plant, :math:`\delta x_{k+1} = A \delta x_k + B \delta u_k`; ``system()`` has its period."""
        result = linearise(self, x, u)
        eye = np.eye(len(result.x))
        return result._replace(A=eye + self.period * result.A, B=self.period * result.B, period=self.period)


def linearise(model: Any, x: Sequence[float], u: Sequence[float]) -> Linear:
    """Linearise a model.

    Parameters
    ----------
    model : casadi.Function or callable
        ``(x, u) -> (dx, y)``.
    x, u : sequence of float
        Operating point; it need not be an equilibrium.
    """
    point, inputs = np.asarray(x, dtype=float), np.asarray(u, dtype=float)
    evaluate, jacobian = _derivatives(model, point.size, inputs.size)
    (A, B), (C, D) = jacobian(point, inputs)
    return Linear(A, B, C, D, point, inputs, evaluate(point, inputs)[1])


def equilibrium(
    model: Any,
    x: Sequence[float],
    u: Sequence[float],
    *,
    held: Sequence[int] = (),
    free: Sequence[int] = (),
    moving: Sequence[int] = (),
    tolerance: float = 1e-9,
) -> tuple[Array, Array]:
    """Find an equilibrium of a model by Newton's method.

    Parameters
    ----------
    model : casadi.Function or callable
        ``(x, u) -> (dx, y)``.
    x, u : sequence of float
        Starting point.
    held : sequence of int
        States that keep their value: "at which voltage is the speed 100 rad/s?" holds the speed.
    free : sequence of int
        Inputs that are solved for: the voltage in this example.
    moving : sequence of int
        States whose derivative need not vanish (an angle that turns); they keep their value.
    tolerance : float
        Largest derivative that counts as rest, relative to 1 + the largest one at the starting point.

    Returns
    -------
    x, u : ndarray
        The equilibrium.

    Raises
    ------
    ValueError
        The numbers of unknowns and conditions differ.
    RunError
        Newton's method did not converge; the error contains the remaining distance.
    """
    states, inputs = np.array(x, dtype=float), np.array(u, dtype=float)
    evaluate, jacobian = _derivatives(model, states.size, inputs.size)
    rows = [i for i in range(states.size) if i not in moving]
    columns = [i for i in range(states.size) if i not in held and i not in moving]
    if len(columns) + len(free) != len(rows):
        raise ValueError(
            f"{len(columns)} states and {len(free)} inputs are free, expected {len(rows)} in all: one for "
            "each derivative that is to vanish"
        )
    # The 1 keeps the tolerance above zero when the starting point is nearly at rest.
    scale = 1.0 + float(np.abs(evaluate(states, inputs)[0][rows]).max(initial=0.0))
    for _ in range(50):
        residual = evaluate(states, inputs)[0][rows]
        size = float(np.abs(residual).max(initial=0.0))
        if size <= tolerance * scale:
            return states, inputs
        (A, B), _ = jacobian(states, inputs)
        try:
            # The kit's own elimination has the same bits on every CPU, unlike LAPACK.
            move = solve(np.hstack([A[np.ix_(rows, columns)], B[np.ix_(rows, list(free))]]), residual)
        except np.linalg.LinAlgError:
            break
        # Far from the equilibrium a full step may overshoot, so it is halved until the largest derivative decreases.
        share = 1.0
        while share > 1e-6:
            new_x, new_u = states.copy(), inputs.copy()
            new_x[columns] -= share * move[: len(columns)]
            new_u[list(free)] -= share * move[len(columns) :]
            result = np.abs(evaluate(new_x, new_u)[0][rows]).max()
            # This is false for NaN, too, so a step out of the domain is halved as well.
            if result < size:
                break
            share /= 2.0
        states, inputs = new_x, new_u
    raise RunError(f"no equilibrium found near x = {list(x)}, u = {list(u)}: the largest derivative left is {size:.3g}")


Pair = tuple[Array, Array]


def _derivatives(
    model: Any, n: int, m: int
) -> tuple[Callable[[Array, Array], Pair], Callable[[Array, Array], tuple[Pair, Pair]]]:
    """Return functions that evaluate a model, (dx, y), and its Jacobians, ((A, B), (C, D))."""
    # A casadi function is recognised by its attribute, so that casadi need not be installed for Python functions.
    if hasattr(model, "n_in"):
        import casadi as ca

        x, u = ca.MX.sym("x", n), ca.MX.sym("u", m)
        dx, y = model(x, u)
        exact = ca.Function("jacobians", [x, u], [ca.jacobian(e, v) for e in (dx, y) for v in (x, u)])

        def evaluate(x: Array, u: Array) -> Pair:
            dx, y = model(x, u)
            return dx.full().ravel(), y.full().ravel()

        def jacobian(x: Array, u: Array) -> tuple[Pair, Pair]:
            A, B, C, D = (block.full() for block in exact(x, u))
            return (A, B), (C, D)

        return evaluate, jacobian

    def evaluate_plain(x: Array, u: Array) -> Pair:
        dx, y = model(x, u)
        return np.asarray(dx, dtype=float), np.asarray(y, dtype=float)

    def differences(x: Array, u: Array) -> tuple[Pair, Pair]:
        both = np.concatenate([x, u])
        columns = []
        for i in range(n + m):
            # A number near zero has no size of its own, so its step is that of one.
            h = STEP * max(1.0, abs(both[i]))
            values = []
            for k in (-2.0, -1.0, 1.0, 2.0):
                moved = both.copy()
                moved[i] += k * h
                values.append(np.concatenate(evaluate_plain(moved[:n], moved[n:])))
            a, b, c, d = values
            columns.append((a - 8.0 * b + 8.0 * c - d) / (12.0 * h))
        J = np.array(columns).T
        return (J[:n, :n], J[:n, n:]), (J[n:, :n], J[n:, n:])

    return evaluate_plain, differences
