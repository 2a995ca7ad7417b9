"""Speed profiles: jerk-minimal polynomial, trapezoid, step."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Literal

import numpy as np

Kind = Literal["jerk", "trapezoid", "step"]
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Quintic:
    """Jerk-minimal motion x(t) = x_0 + alpha_1 t + ... + alpha_5 t^5.

    Parameters
    ----------
    alpha : tuple of 5 floats
        alpha_1 to alpha_5, m/s to m/s^5.
    """

    alpha: tuple[float, float, float, float, float]

    @classmethod
    def between(cls, v_0: float, a_0: float, v_d: float, T: float, distance: float | None = None) -> Quintic:
        """Solve eq. (12) for speed v_d without acceleration at T.

        ::

            alpha_5 = 6 D/T^5 - 3 (v_d + v_0)/T^4 - a_0/(2 T^3)
            alpha_4 = -15 D/T^4 + (7 v_d + 8 v_0)/T^3 + 3 a_0/(2 T^2)
            alpha_3 = 10 D/T^3 - (4 v_d + 6 v_0)/T^2 - 3 a_0/(2 T)
            alpha_2 = a_0/2,  alpha_1 = v_0

        Eq. (14) of the paper leaves out the factors 5, 4, 3 of the derivative; as printed the speed at T is D/T.

        Parameters
        ----------
        v_0, a_0 : float
            Speed and acceleration at 0, m/s and m/s^2.
        v_d : float
            Speed at T, m/s.
        T : float
            s, > 0.
        distance : float, optional
            D = x(T) - x(0), m. When absent the one with the least integral of jerk^2 (alpha_5 = 0): from rest v_d T/2,
            which gives v = v_d (3 s^2 - 2 s^3), s = t/T.

        Returns
        -------
        Quintic
        """
        D = (v_d + v_0) * T / 2 + a_0 * T * T / 12 if distance is None else distance
        fifth = 0.0 if distance is None else 6 * D / T**5 - 3 * (v_d + v_0) / T**4 - a_0 / (2 * T**3)
        fourth = -15 * D / T**4 + (7 * v_d + 8 * v_0) / T**3 + 3 * a_0 / (2 * T**2)
        third = 10 * D / T**3 - (4 * v_d + 6 * v_0) / T**2 - 3 * a_0 / (2 * T)
        return cls((v_0, a_0 / 2, third, fourth, fifth))

    def at(self, t: float) -> Point:
        """Return distance (m), speed (m/s) and acceleration (m/s^2) at t (s)."""
        a1, a2, a3, a4, a5 = self.alpha
        return (
            ((((a5 * t + a4) * t + a3) * t + a2) * t + a1) * t,
            (((5 * a5 * t + 4 * a4) * t + 3 * a3) * t + 2 * a2) * t + a1,
            ((20 * a5 * t + 12 * a4) * t + 6 * a3) * t + 2 * a2,
        )

    def speed_range(self, T: float) -> tuple[float, float]:
        """Return the least and the largest speed in [0, T]."""
        _, a2, a3, a4, a5 = self.alpha
        turns = np.roots([20 * a5, 12 * a4, 6 * a3, 2 * a2])
        times = [0.0, T, *(float(z.real) for z in turns if abs(z.imag) < 1e-9 * T and 0.0 < z.real < T)]
        speeds = [self.at(t)[1] for t in times]
        return min(speeds), max(speeds)


@dataclass(frozen=True)
class Profile:
    """Acceleration from rest, cruise, mirrored braking to rest.

    Parameters
    ----------
    kind : {"jerk", "trapezoid", "step"}
        Shape of the acceleration; a step has none.
    v_d : float
        Cruise speed, m/s.
    t_d : float
        Duration of the acceleration, s.
    x_d : float, optional
        jerk: distance of the acceleration, m; the jerk-minimal v_d t_d/2 when absent.
    t_b, t_db : float
        Begin and duration of the braking, s; the way of the braking is v_d t_db/2.
    """

    kind: Kind
    v_d: float
    t_d: float
    x_d: float | None = None
    t_b: float = inf
    t_db: float = 1.0

    def at(self, t: float) -> Point:
        """Return position (m), speed (m/s) and acceleration (m/s^2) at t (s)."""
        t_b, t_db = self.t_b, self.t_db
        if t <= t_b:
            return self._forward(t)
        position = self._forward(t_b)[0]
        if self.kind == "step":
            return position, 0.0, 0.0
        # The braking is the acceleration run backwards, shortest way: x(t_db) - x(t_db - t)
        distance = self._ramp(t_db, t_db, None)[0]
        left = max(0.0, t_db - (t - t_b))
        x, v, a = self._ramp(left, t_db, None)
        return position + distance - x, v, (-a if left > 0.0 else 0.0)

    def _forward(self, t: float) -> Point:
        if self.kind == "step":
            return self.v_d * t, self.v_d, 0.0
        if t < self.t_d:
            return self._ramp(t, self.t_d, self.x_d)
        return self._ramp(self.t_d, self.t_d, self.x_d)[0] + self.v_d * (t - self.t_d), self.v_d, 0.0

    def _ramp(self, t: float, T: float, distance: float | None) -> Point:
        """Return the acceleration profile from rest to v_d in T."""
        if self.kind == "jerk":
            return Quintic.between(0.0, 0.0, self.v_d, T, distance).at(t)
        a = self.v_d / T
        return 0.5 * a * t * t, a * t, a
