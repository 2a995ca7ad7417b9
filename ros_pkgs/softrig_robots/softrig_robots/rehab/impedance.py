r"""Impedance law: the patient's force bends the reference, equations (23) and (24) of the paper.

.. math::
    M_d (\ddot q_r - \ddot q_d) + B_d (\dot q_r - \dot q_d) + K_d (q_r - q_d) = -J(q)^T F_e
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from softrig_core import (
    Block,
    BlockParams,
    Level,
    Sample,
    Values,
    joint_state,
    number,
    param,
    reference,
    to_ns,
    wrench,
)

from ..joints import PerJoint, require_positive, spread
from .force import clip_force
from .model import JOINTS, foot_jacobian
from .patient import FOOT, PATIENT_FORCE

Vector = tuple[float, ...]
UNITS = {"position": "rad", "velocity": "rad/s", "acceleration": "rad/s^2"}


class ImpedanceParams(BlockParams):
    """Critically damped at 10 rad/s (the paper prints no values)."""

    period: float = param(0.001, "sampling period T", "s", gt=0.0, le=100.0)
    inertia: PerJoint = param((1.0,), "desired inertia M_d", "kg m^2", live=True)
    damping: PerJoint = param((20.0,), "desired damping B_d", "N m s/rad", live=True)
    stiffness: PerJoint = param((100.0,), "desired stiffness K_d", "N m/rad", live=True)
    length: tuple[float, float] = param((0.5, 0.45), "lengths l_i of thigh and shank", "m")
    force_limit: float = param(200.0, "a larger force at the foot is limited to this", "N", gt=0.0, live=True)
    stale_after: int = param(
        20, "periods without a new force or reference after which it counts as lost", ge=1, le=1000000, live=True
    )

    def _check(self) -> None:
        n = len(JOINTS)
        require_positive("inertia", spread("inertia", self.inertia, n))
        require_positive("damping", spread("damping", self.damping, n), or_zero=True)
        require_positive("stiffness", spread("stiffness", self.stiffness, n), or_zero=True)
        require_positive("length", self.length)


class State(NamedTuple):
    """Damping (N m s/rad), stiffness (N m/rad), q_r (rad) and its rate (rad/s) a joint, ticks refused in a row.

    q_r and its rate are empty before the first reference.
    """

    damping: Vector
    stiffness: Vector
    q: Vector = ()
    v: Vector = ()
    refusals: int = 0


Answer = tuple[State, Mapping[str, Vector]]


class Impedance(Block[ImpedanceParams]):
    """Reference, force and joint states in, regenerated reference out; semi-implicit Euler.

    The regenerated reference starts on the reference. If the force or the reference is lost, or if a message of every
    tick is rejected for as long, the regenerated reference keeps its position with speed zero. It continues from there
    when valid messages arrive again. Stiffness, damping and inertia can be changed during a run: the regenerated
    reference and its rate have no jump. A message on the topic of stiffness or damping overrules the parameter.
    """

    INPUTS = (
        reference("reference", "reference", JOINTS, **UNITS),
        wrench(PATIENT_FORCE, PATIENT_FORCE, FOOT, held=True, delayed=True),
        joint_state("joint_states", "joint_states", JOINTS, position="rad"),
        number("stiffness", "impedance/stiffness", "N m/rad", held=True),
        number("damping", "impedance/damping", "N m s/rad", held=True),
    )
    OUTPUTS = (reference("regenerated", "regenerated", JOINTS, **UNITS),)

    @classmethod
    def assumed(cls, params: ImpedanceParams) -> Mapping[str, Any]:
        """The leg by which a force at the foot becomes torques."""
        return {"rehab/segments.length": params.length}

    def setup(self) -> None:
        """Spread the matrices' diagonals."""
        n = len(JOINTS)
        self._M = spread("inertia", self.p.inertia, n)
        self._stale = self.p.stale_after * to_ns(self.p.period)

    def first(self) -> State:
        """Wait for the first reference."""
        n = len(JOINTS)
        return State(spread("damping", self.p.damping, n), spread("stiffness", self.p.stiffness, n))

    def go_on(self, x: State, before: ImpedanceParams) -> State:
        """Continue with another impedance; an unchanged one stays that of the topic."""
        now, p = self.first(), self.p
        return x._replace(
            damping=x.damping if p.damping == before.damping else now.damping,
            stiffness=x.stiffness if p.stiffness == before.stiffness else now.stiffness,
        )

    def _wanted(self, name: str, value: Vector | None, now: Vector) -> Vector:
        """Accept a new value for both joints, unless it is missing or negative."""
        if value is None:
            return now
        if value[0] < 0.0:
            self.report(Level.ERROR, name, f"{name} = {value[0]:g} was refused, expected no negative value")
            return now
        return value * len(JOINTS)

    def update(
        self,
        x: State,
        t: int,
        *,
        reference: Vector,
        patient_force: Sample | None,
        joint_states: Vector,
        stiffness: Vector | None = None,
        damping: Vector | None = None,
    ) -> Answer:
        """Return q_r, its rate and acceleration at t."""
        n, T = len(JOINTS), self.p.period
        B, K, q, v, _ = x
        K = self._wanted("stiffness", stiffness, K)
        B = self._wanted("damping", damping, B)
        if not q:
            q, v = reference[:n], reference[n : 2 * n]
        if patient_force is not None and t - patient_force.stamp > self._stale:
            self.report(Level.ERROR, "patient", "no more messages of the patient's force: the reference is held")
            return _stand(B, K, q, 0)
        if (self.age("reference") or 0) > self._stale:
            self.report(Level.ERROR, "reference", "no more messages of the reference: the regenerated one is held")
            return _stand(B, K, q, 0)
        fx, _, fz = clip_force(self, patient_force and patient_force.data, self.p.force_limit)
        x1, x2, z1, z2 = foot_jacobian(joint_states[0], joint_states[1], *self.p.length)
        torque = (x1 * fx + z1 * fz, x2 * fx + z2 * fz)  # J^T F_e
        a, v_next, q_next = [], [], []
        for i in range(n):
            pull = B[i] * (reference[n + i] - v[i]) + K[i] * (reference[i] - q[i])
            a.append(reference[2 * n + i] + (pull - torque[i]) / self._M[i])
            v_next.append(v[i] + T * a[i])
            q_next.append(q[i] + T * v_next[i])
        return State(B, K, tuple(q_next), tuple(v_next)), {"regenerated": (*q, *v, *a)}

    def refused(self, x: State, t: int) -> tuple[State, Values | None]:
        """Repeat the last value; after `stale_after` ticks hold still."""
        refusals = x.refusals + 1
        if not x.q or refusals <= self.p.stale_after:
            return x._replace(refusals=refusals), None
        self.report(Level.ERROR, "refused", f"{self.p.stale_after} ticks with a rejected input: the reference is held")
        return _stand(x.damping, x.stiffness, x.q, refusals)


def _stand(damping: Vector, stiffness: Vector, q: Vector, refusals: int) -> Answer:
    """Stay where it is."""
    still = (0.0,) * len(q)
    return State(damping, stiffness, q, still, refusals), {"regenerated": (*q, *still, *still)}
