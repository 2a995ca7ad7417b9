"""PID law with filtered derivative and conditional anti-windup."""

from __future__ import annotations

from typing import NamedTuple

from softrig_core import Params, param


class PidParams(Params):
    """Gains of `Pid`; inherit for a node's parameters and set the published values."""

    kp: float = param(1.0, "proportional gain Kp", live=True)
    ki: float = param(0.0, "integral gain Ki", "1/s", live=True)
    kd: float = param(0.0, "derivative gain Kd", "s", live=True)
    n_filter: float = param(100.0, "corner N of the derivative filter Kd N s/(s + N)", "1/s", gt=0.0, live=True)
    anti_windup: bool = param(
        True, "stop the integral while the output is beyond u_max and the error drives it on", live=True
    )
    u_max: float = param(
        1.0, "actuator limit that anti_windup assumes; the output itself is not clipped", gt=0.0, live=True
    )


class PidState(NamedTuple):
    """Integral and filtered derivative, in units of the output; error of the tick before."""

    integral: float = 0.0
    derivative: float = 0.0
    error: float = 0.0


class Pid:
    """Sampled PID controller; its state is a `PidState`.

    ::

        d_k = (d_(k-1) + Kd N (e_k - e_(k-1)))/(1 + N Ts)     backward difference, e_(-1) = 0
        u_k = Kp e_k + I_k + d_k
        I_(k+1) = I_k + Ki e_k Ts                             unless |u_k| > u_max and u_k Ki e_k > 0

    Parameters
    ----------
    period : float
        Ts in s.

    Notes
    -----
    `go_on` is bumpless, u is the same for the same error: I is stored in units of u, so another Ki acts only on later
    errors. Another Kp moves the difference (Kp_old - Kp_new) e into I, as Astrom and Hagglund propose [1]_. The
    derivative's state d stays, and another Kd or N acts on the next change of e. Without integral action (Ki = 0) that
    difference would remain forever, so I stays and u jumps with Kp.

    References
    ----------
    .. [1] K. J. Astrom, T. Hagglund, PID Controllers: Theory, Design, and Tuning, 2nd ed., ISA 1995, chapter 3.
    """

    def __init__(self, gains: PidParams, period: float) -> None:
        self._kp = gains.kp
        self._ki_ts = gains.ki * period
        self._kd_n = gains.kd * gains.n_filter
        self._decay = 1.0 + gains.n_filter * period
        self._limit = gains.u_max if gains.anti_windup else float("inf")

    def go_on(self, x: PidState, before: PidParams) -> PidState:
        """Return the state with which these gains follow those of before, without a bump."""
        return self.after_kp(x, before.kp)

    def after_kp(self, x: PidState, kp: float) -> PidState:
        """Return the state of `go_on`, which depends on the old gains only by Kp."""
        if self._ki_ts and self._kp != kp:
            return x._replace(integral=x.integral + (kp - self._kp) * x.error)
        return x

    def __call__(self, x: PidState, error: float) -> tuple[PidState, float]:
        """Return the state after the error e_k, and u_k."""
        integral, d, last = x
        d = (d + self._kd_n * (error - last)) / self._decay
        u = self._kp * error + integral + d
        step = self._ki_ts * error
        # The sign of Ki e counts and not that of e: with Ki < 0 (a reverse-acting law) the other sign drives u further.
        if abs(u) <= self._limit or u * step <= 0.0:
            integral += step
        return PidState(integral, d, error), u
