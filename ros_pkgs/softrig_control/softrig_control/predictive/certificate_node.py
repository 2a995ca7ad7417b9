"""The dual-mode certificate of a model as a node."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from softrig_core import Block, BlockParams, Level, Port, array, button, param, scalars

from .carima import Carima
from .certificate import Certificate, assess, certify, companion


class CertificateParams(BlockParams):
    """Model, weights, and optionally an externally computed K and Qbar."""

    period: float = param(0.1, "time between checks of the button", "s", gt=0.0, le=100.0)
    num: tuple[float, ...] = param((2.8286, 2.8286 * 175100.0), "numerator, highest power of s first", max_length=50)
    den: tuple[float, ...] = param(
        (1.0, 51.17 + 125.7, 51.17 * 125.7), "denominator, highest power of s first", max_length=50
    )
    T: float = param(0.001, "sampling time of the model", "s", gt=0.0, le=10.0)
    Q: float = param(1.0, "weight of y: Q C'C", gt=0.0, le=1e12)
    R: float = param(1.0, "weight of u", gt=0.0, le=1e12)
    K: tuple[float, ...] = param((), "feedback u = K x to be checked, with Qbar; empty: solve the Riccati equation")
    Qbar: tuple[float, ...] = param((), "terminal cost to be checked, row by row")

    def _check(self) -> None:
        n = len(companion(self.carima())[0])
        if (len(self.K), len(self.Qbar)) not in ((0, 0), (n, n * n)):
            raise ValueError(f"K has {len(self.K)}, Qbar {len(self.Qbar)} values, expected {n} and {n * n}, or none")

    def carima(self) -> Carima:
        """Sample the model."""
        return Carima.from_continuous(self.num, self.den, self.T)


class State(NamedTuple):
    """Whether work is requested, as it is by the first tick, and whether the button is down."""

    asked: bool = False
    down: bool = False


class CertificateNode(Block[CertificateParams]):
    """Answers at its first tick and at each press of its button: K, Qbar, the closed loop's moduli and the verdict.

    ``certificate/verdict``: valid (1 or 0), largest modulus of the closed loop, smallest eigenvalue of Qbar, residual
    of the corrected (32), smallest eigenvalue of its left side less Q + K'RK. An invalid certificate is reported as a
    warning. It applies to the transfer function and sampling time in the node's own parameters, without bounds. It is
    not compared with the rest of the rig; /diagnostics name these parameters.
    """

    STATE = State

    @classmethod
    def ports(cls, params: CertificateParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Arrays of the size of the model."""
        n = len(companion(params.carima())[0])
        verdict = {"valid": "", "modulus": "", "definite": "", "residual": "", "decrease": ""}
        return (button("certify", "certify", held=True),), (
            array("gain", "certificate/gain", {"state": n}, "", sporadic=True),
            array("terminal", "certificate/terminal", {"row": n, "column": n}, "", sporadic=True),
            array("moduli", "certificate/moduli", {"pole": n}, "", sporadic=True),
            scalars("verdict", "certificate/verdict", verdict, sporadic=True),
        )

    def update(self, x: State, t: int, *, certify: tuple[float, ...] | None) -> tuple[State, Mapping[str, Any]]:
        """Publish the result when the button is pressed."""
        down = certify is not None and certify[0] != 0.0
        pressed = not x.asked or (down and not x.down)
        return State(True, down), self._answer() if pressed else {}

    def refused(self, x: State, t: int) -> tuple[State, Mapping[str, Any]]:
        """A press that cannot be read gets silence."""
        return x, {}

    def health(self, x: State) -> Mapping[str, str]:
        """Describe the subject of the certificate."""
        p = self.p
        return {"model": f"num = {list(p.num)}, den = {list(p.den)}, T = {p.T:g} s, Q = {p.Q:g}, R = {p.R:g}"}

    def _answer(self) -> Mapping[str, Any]:
        result = self._certificate()
        if not result.valid:
            self.report(
                Level.WARN,
                "no_certificate",
                f"no certificate: |eig(A + BK)| = {result.moduli[0]:.4g}, "
                f"residual {result.residual:.3g}, Qbar's smallest eigenvalue {result.definite:.3g}",
            )
        return {
            "gain": tuple(result.gain.ravel().tolist()),
            "terminal": tuple(result.terminal.ravel().tolist()),
            "moduli": tuple(result.moduli.tolist()),
            "verdict": (
                float(result.valid),
                float(result.moduli[0]),
                result.definite,
                result.residual,
                result.decrease,
            ),
        }

    def _certificate(self) -> Certificate:
        p = self.p
        model = p.carima()
        if not p.K:
            return certify(model, p.R, p.Q)
        a, b, c = companion(model)
        terminal = [p.Qbar[k : k + len(a)] for k in range(0, len(p.Qbar), len(a))]
        return assess(a, b, [p.K], terminal, p.Q * c.T @ c, p.R)
