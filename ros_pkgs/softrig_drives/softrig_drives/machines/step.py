"""One period of a machine on its inverter, written once for all machines."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from softrig_core import jit

from .inverter import FALLING, NEVER, ON, begin, drop, edge, lost
from .mechanics import finer, friction

SQRT3 = 3.0**0.5
STATES = 9  # four of the machine, omega, theta, omega_l, theta_l, u_dc
Vector = tuple[float, ...]


@cache
def stepper(machine: Any, observe: Any) -> Callable[..., Vector]:
    """Create the function that moves a machine by one period.

    Parameters
    ----------
    machine, observe : callable
        `rates` and `observe` of a machine's module.

    Returns
    -------
    callable
        See `advance` within.
    """

    @jit
    def rates(
        a: float, b: float, c: float, d: float, w: float, th: float, w_l: float, th_l: float, u_dc: float,
        q_alpha: float, q_beta: float, e_alpha: float, e_beta: float, load: float, m: Any, inv: Any, mech: Any
    ) -> Vector:  # fmt: skip
        """Return the rates of the nine states.

        ::

            u_s = q u_dc - e                           q: duty ratios or switches as a space vector, e: drops
            J omega' = T - T_f(omega) - T_shaft        T_shaft: the load, or the shaft to the second mass
            C_dc u_dc' = (U_dc - u_dc)/R_dc - 3/2 Re(q conj(i_s))
        """
        da, db, dc, dd, torque, i_alpha, i_beta = machine(
            a, b, c, d, th, w, q_alpha * u_dc - e_alpha, q_beta * u_dc - e_beta, m
        )
        du = 0.0
        if inv[3] > 0.0:
            source = (inv[1] - u_dc) / inv[2]
            if inv[4] > 0.0:
                source = max(source, 0.0)
            du = (source - 1.5 * (q_alpha * i_alpha + q_beta * i_beta)) * inv[3]
        drag = friction(w, mech[1], mech[2], mech[3], mech[4], mech[5])
        if mech[6] > 0.0:
            shaft = mech[7] * (th - th_l) + mech[8] * (w - w_l)
            pull = load + mech[9] * w_l * abs(w_l)
            return da, db, dc, dd, (torque - drag - shaft) * mech[0], w, (shaft - pull) * mech[6], w_l, du
        pull = load + mech[9] * w * abs(w)
        return da, db, dc, dd, (torque - drag - pull) * mech[0], w, 0.0, 0.0, du

    @jit
    def moved(x: Any, h: float, k: Any) -> Vector:
        return (
            x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2], x[3] + h * k[3], x[4] + h * k[4], x[5] + h * k[5],
            x[6] + h * k[6], x[7] + h * k[7], x[8] + h * k[8],
        )  # fmt: skip

    @jit
    def slope(x: Any, q_alpha: float, q_beta: float, e_alpha: float, e_beta: float, load: float, m: Any, inv: Any,
              mech: Any) -> Vector:  # fmt: skip
        return rates(
            x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7], x[8], q_alpha, q_beta, e_alpha, e_beta, load, m, inv, mech
        )

    @jit
    def phases(x: Any, m: Any) -> tuple[float, float, float]:
        i_alpha, i_beta, _ = observe(x[0], x[1], x[2], x[3], x[5], m)
        b = -0.5 * i_alpha + 0.5 * SQRT3 * i_beta
        return i_alpha, b, -i_alpha - b

    @jit
    def advance(
        x: Any, duty: Any, rising: bool, tripped: bool, load: Any, change: float, m: Any, inv: Any, mech: Any
    ) -> Vector:
        """Move the nine states by one period, in Runge-Kutta steps of order 4 between the edges.

        Parameters
        ----------
        x : tuple (9,)
            Machine (4), omega (rad/s), theta (rad), omega_l, theta_l of the second mass, u_dc (V).
        duty : tuple (3,)
            Duty ratios of the legs in this period.
        rising : bool
            The carrier of two updates falls from its peak, so that legs switch on.
        load : tuple (2,)
            Load torque (N m) before and after the time `change` (s) within this period.
        m, inv, mech : array
            Constants of `SynchronousConstants.numbers` or another machine's, of `numbers` of the plant, of `Mechanics`.
        """
        period, largest, updates = inv[0], inv[10], int(inv[6])
        # rates that grow with the speed: the electrical angle, the torque of a fan
        pull = 2.0 * mech[9] * max(abs(x[4]) * mech[0], abs(x[6]) * mech[6])
        largest = finer(largest, max(m[4] * abs(x[4]), pull))
        switched = inv[5] > 0.0 and not tripped
        d_a, d_b, d_c = duty[0], duty[1], duty[2]
        if tripped:
            d_a, d_b, d_c = 0.0, 0.0, 0.0
        stage_a, next_a = begin(d_a, updates, rising, period)
        stage_b, next_b = begin(d_b, updates, rising, period)
        stage_c, next_c = begin(d_c, updates, rising, period)
        if not switched:
            next_a = next_b = next_c = NEVER
        s_a, s_b, s_c = d_a, d_b, d_c
        share = 0.0 if switched else inv[7] / (period * updates)
        drops = inv[8] > 0.0 or inv[9] > 0.0
        t = 0.0
        while t < period:
            end = max(t, min(period, next_a, next_b, next_c))  # a pulse that dead time has swallowed ends late
            if t < change < end:
                end = change
            if switched:
                s_a = 1.0 if stage_a in (ON, FALLING) else 0.0
                s_b = 1.0 if stage_b in (ON, FALLING) else 0.0
                s_c = 1.0 if stage_c in (ON, FALLING) else 0.0
            if end > t:
                torque = load[0] if t < change else load[1]
                steps = int((end - t) / largest * 0.999999) + 1
                h = (end - t) / steps
                for _ in range(steps):
                    r_a, r_b, r_c, e_alpha, e_beta = s_a, s_b, s_c, 0.0, 0.0
                    if drops or share > 0.0:
                        i_a, i_b, i_c = phases(x, m)
                        if share > 0.0:
                            r_a, r_b, r_c = (
                                s_a - lost(i_a, s_a, share),
                                s_b - lost(i_b, s_b, share),
                                s_c - lost(i_c, s_c, share),
                            )
                        if drops and not tripped:
                            e_a, e_b = drop(i_a, r_a, inv[8], inv[9]), drop(i_b, r_b, inv[8], inv[9])
                            e_c = drop(i_c, r_c, inv[8], inv[9])
                            e_alpha, e_beta = (2.0 * e_a - e_b - e_c) / 3.0, (e_b - e_c) / SQRT3
                    q_alpha, q_beta = (2.0 * r_a - r_b - r_c) / 3.0, (r_b - r_c) / SQRT3
                    k1 = slope(x, q_alpha, q_beta, e_alpha, e_beta, torque, m, inv, mech)
                    k2 = slope(moved(x, 0.5 * h, k1), q_alpha, q_beta, e_alpha, e_beta, torque, m, inv, mech)
                    k3 = slope(moved(x, 0.5 * h, k2), q_alpha, q_beta, e_alpha, e_beta, torque, m, inv, mech)
                    k4 = slope(moved(x, h, k3), q_alpha, q_beta, e_alpha, e_beta, torque, m, inv, mech)
                    x = moved(moved(moved(x, h / 6.0, k1), h / 3.0, k2), h / 3.0, k3)
                    x = moved(x, h / 6.0, k4)
            t = end
            if switched and t < period:
                i_a, i_b, i_c = phases(x, m)
                if next_a <= t:
                    stage_a, next_a = edge(stage_a, t, i_a, d_a, updates, period, inv[7])
                if next_b <= t:
                    stage_b, next_b = edge(stage_b, t, i_b, d_b, updates, period, inv[7])
                if next_c <= t:
                    stage_c, next_c = edge(stage_c, t, i_c, d_c, updates, period, inv[7])
        return x

    return advance
