r"""What the dynamic laws share: two nested PID-like surfaces per joint.

.. math::
    s = \dot e + a_1 e + a_2 \int e, \qquad \sigma = \dot s + b_1 s + b_2 \int s, \qquad e = q_d - q

Differentiating sigma along :math:`\ddot q = v - g` gives :math:`\dot\sigma = q_d^{(3)} + \mu_1 (\ddot q_d - v)
+ \mu_2 \dot e + \mu_3 e + \mu_4 \int e - \dot v + f` with the lumped uncertainty f.
"""

from __future__ import annotations

from typing import NamedTuple

from softrig_core import param

from ..joints import JointGains, PerJoint


class SurfaceGains(JointGains):
    """Gains of both surfaces."""

    a1: PerJoint = param((10.0,), "proportional gain of the first surface", "1/s", live=True)
    a2: PerJoint = param((0.1,), "integral gain of the first surface", "1/s^2", live=True)
    b1: PerJoint = param((20.0,), "proportional gain of the second surface", "1/s", live=True)
    b2: PerJoint = param((0.2,), "integral gain of the second surface", "1/s^2", live=True)


class Coefficients(NamedTuple):
    """mu_1 ... mu_4 of the derivative of sigma."""

    mu1: float
    mu2: float
    mu3: float
    mu4: float

    @classmethod
    def of(cls, a1: float, a2: float, b1: float, b2: float, printed: bool) -> Coefficients:
        """Derive them from the gains.

        Parameters
        ----------
        printed : bool
            Use mu_1 = a_1 + b_2 as equations (18) and (19) of the paper print it. Differentiating sigma gives
            a_1 + b_1, with which alone the stability proof holds.
        """
        return cls(a1 + (b2 if printed else b1), a2 + a1 * b1 + b2, a2 * b1 + a1 * b2, a2 * b2)
