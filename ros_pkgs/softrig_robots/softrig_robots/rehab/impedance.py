r"""Impedance law: the patient's force bends the reference, equations (23) and (24) of the paper.

.. math::
    M_d (\ddot q_r - \ddot q_d) + B_d (\dot q_r - \dot q_d) + K_d (q_r - q_d) = -J(q)^T F_e
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

from pydantic import model_validator
from softrig_core import (
    Block,
    BlockParams,
    Level,
    Sample,
    executable,
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
    force_limit: float = param(200.0, "a larger force at the foot is cut down to this", "N", gt=0.0, live=True)
    stale_after: int = param(20, "periods without a new force or reference after which it counts as lost", ge=1,
                             le=1000000, live=True)  # fmt: skip

    @model_validator(mode="after")
    def _possible(self) -> Self:
        n = len(JOINTS)
        require_positive("inertia", spread("inertia", self.inertia, n))
        require_positive("damping", spread("damping", self.damping, n), or_zero=True)
        require_positive("stiffness", spread("stiffness", self.stiffness, n), or_zero=True)
        require_positive("length", self.length)
        return self


class Impedance(Block[ImpedanceParams]):
    """Reference, force and joint states in, regenerated reference out; semi-implicit Euler.

    Starts on the reference. When the force or the reference stops coming, or something of every tick is refused for as
    long, the regenerated reference stays where it is with speed zero, and goes on from there when they come again.
    Stiffness, damping and inertia can be changed while it runs: the regenerated reference and its rate go on without a
    jump. Who publishes stiffness or damping on its topic overrules the parameter.
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

    def change(self, params: ImpedanceParams) -> None:
        """Take another impedance."""
        n, before = len(JOINTS), self.p
        super().change(params)
        if params.damping != before.damping:
            self._B = spread("damping", params.damping, n)
        if params.stiffness != before.stiffness:
            self._K = spread("stiffness", params.stiffness, n)

    def start(self) -> None:
        """Wait for the first reference."""
        n = len(JOINTS)
        self._B = spread("damping", self.p.damping, n)
        self._K = spread("stiffness", self.p.stiffness, n)
        self._q: list[float] = []
        self._v: list[float] = []
        self._refusals = 0

    def _wanted(self, name: str, value: Vector | None, now: Vector) -> Vector:
        """Take a new value for both joints, unless there is none or it is negative."""
        if value is None:
            return now
        if value[0] < 0.0:
            self.report(Level.ERROR, name, f"{name} = {value[0]:g} was refused, expected no negative value")
            return now
        return value * len(JOINTS)

    def update(
        self, t: int, *, reference: Vector, patient_force: Sample | None, joint_states: Vector,
        stiffness: Vector | None = None, damping: Vector | None = None,
    ) -> Mapping[str, Vector]:  # fmt: skip
        """Give q_r, its rate and acceleration at t."""
        n, T = len(JOINTS), self.p.period
        self._K = self._wanted("stiffness", stiffness, self._K)
        self._B = self._wanted("damping", damping, self._B)
        if not self._q:
            self._q, self._v = list(reference[:n]), list(reference[n : 2 * n])
        self._refusals = 0
        if patient_force is not None and t - patient_force.stamp > self._stale:
            self.report(Level.ERROR, "patient", "the patient's force has stopped coming: the reference stands still")
            return self._stand()
        if (self.age("reference") or 0) > self._stale:
            self.report(Level.ERROR, "reference", "the reference has stopped coming: what is regenerated stands still")
            return self._stand()
        fx, _, fz = clip_force(self, patient_force and patient_force.data, self.p.force_limit)
        x1, x2, z1, z2 = foot_jacobian(joint_states[0], joint_states[1], *self.p.length)
        torque = (x1 * fx + z1 * fz, x2 * fx + z2 * fz)  # J^T F_e
        q, v = tuple(self._q), tuple(self._v)
        a = []
        for i in range(n):
            pull = self._B[i] * (reference[n + i] - v[i]) + self._K[i] * (reference[i] - q[i])
            a.append(reference[2 * n + i] + (pull - torque[i]) / self._M[i])
            self._v[i] += T * a[i]
            self._q[i] += T * self._v[i]
        return {"regenerated": (*q, *v, *a)}

    def refused(self, t: int) -> Mapping[str, Vector] | None:
        """Say the last again, after `stale_after` ticks stand still."""
        self._refusals += 1
        if not self._q or self._refusals <= self.p.stale_after:
            return None
        self.report(Level.ERROR, "refused", f"{self.p.stale_after} ticks of which something was refused: stands still")
        return self._stand()

    def _stand(self) -> Mapping[str, Vector]:
        """Stay where it is."""
        self._v = [0.0] * len(self._q)
        return {"regenerated": (*self._q, *(0.0,) * (2 * len(self._q)))}


main = executable(Impedance)
