"""The certificate as a node: solver work in its own process, matrices and verdict on topics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from softrig_core import (
    Array,
    Level,
    Port,
    Result,
    SolverParams,
    Work,
    array,
    button,
    param,
    scalars,
)

from .params import AskedSolver, AskedState, SystemParams, law_of_the_tank
from .proof.applicability import NotApplicable
from .proof.certify import Certificate, Criterion, certified_margin, certify
from .proof.level import level_bound, level_margin
from .system import TANK_C

VERDICT = {"h": "s", "valid": "", "t": "", "smallest": "", "inequalities": ""}


class CriterionParams(SystemParams):
    """System and criterion."""

    method: Literal["theorem1", "constant", "level"] = param(
        "theorem1", "Theorem 1, the criterion for constant delays, or the level of the tank"
    )
    mu: float = param(0.0, "bound of the rate of the delay; 0: any constant delay up to h", ge=0.0, le=100.0)
    order: int = param(2, "constant: number of Legendre integrals", ge=1, le=8)
    cell_terms: bool = param(False, "with the matrices U_i, slower and a little better")

    @property
    def criterion(self) -> Criterion:
        """The criterion of the linear matrix inequalities."""
        return Criterion("constant" if self.method == "constant" else "theorem1", self.mu, self.order, self.cell_terms)

    def shapes(self) -> dict[str, tuple[int, int]]:
        """Return name and shape of every matrix of a certificate, in the order of the topic."""
        if self.method == "level" or self.system == "tank":
            return {}
        unknowns = self.criterion.problem(self.build()).unknowns
        return {name: u.shape for name, u in unknowns.items()}

    def padded(self) -> tuple[int, int, int]:
        """Return the size of the array for all matrices, each padded with zeros."""
        shapes = self.shapes().values()
        return len(shapes), max(s[0] for s in shapes), max(s[1] for s in shapes)

    def pad(self, matrices: Mapping[str, Array]) -> tuple[float, ...]:
        """Copy matrices into the array."""
        total = np.zeros(self.padded())
        for k, name in enumerate(self.shapes()):
            rows, columns = matrices[name].shape
            total[k, :rows, :columns] = matrices[name]
        return tuple(total.ravel().tolist())

    def unpad(self, values: tuple[float, ...]) -> dict[str, Array]:
        """Copy the matrices out of the array."""
        total = np.array(values).reshape(self.padded())
        return {name: total[k, :r, :c].copy() for k, (name, (r, c)) in enumerate(self.shapes().items())}

    def matrices_port(self, **options: Any) -> Port:
        """Return the topic of the matrices."""
        count, rows, columns = self.padded()
        sizes = {"matrix": count, "row": rows, "column": columns}
        return array("matrices", "certificate/matrices", sizes, "", **options)


class CertificateParams(CriterionParams, SolverParams):
    """The request to the worker."""

    h: float = param(0.0, "delay bound; 0: the largest that can be certified", "s", ge=0.0, le=1e6)
    low: float = param(0.0, "start of the search; 0: automatic", "s", ge=0.0, le=1e6)
    high: float = param(0.0, "where it ends at first; 0: found by itself", "s", ge=0.0, le=1e6)
    width: float = param(1e-4, "relative width at which the search ends", ge=1e-9, le=0.1)
    at_start: bool = param(True, "ask once at the start; later at each press of the button")
    switch: float = param(0.5, "level: level at which the controller changes its gain", ge=0.0, le=10.0)
    k_low: float = param(0.2, "level: gain below it", "1/s", ge=0.0, le=10.0)
    k_high: float = param(0.1, "level: gain above it, taken away", "1/s", ge=0.0, le=10.0)
    c: float = param(TANK_C, "level: drain c of c sqrt(x)", gt=0.0, le=1.0)
    x0: float = param(0.2, "level: at and before the start", ge=0.0, le=10.0)

    def _check(self) -> None:
        if self.method == "level" and self.system != "tank":
            raise ValueError("method = level: expected system = tank")

    @property
    def tank(self) -> dict[str, float]:
        """Return the quantities that the bound of the level depends on."""
        return {"s": self.switch, "kL": self.k_low, "kR": self.k_high, "c": self.c, "start": self.x0}


class Answer(NamedTuple):
    """Result of the worker: a certificate, or None with the reason."""

    certificate: Certificate | None
    reason: str


class CertificateNode(AskedSolver[CertificateParams]):
    """Certifies a delay bound, or searches the largest; published results are verified from the matrices themselves.

    ``certificate/verdict``: h, valid (1 or 0), the solver's margin t, the smallest eigenvalue of any inequality as a
    share of its largest, and the number of inequalities. ``certificate/matrices``: every unknown in the order of the
    problem, in the time t/h, filled up with zeros; names are in the diagnostics. A system to which the theorem does not
    apply gets valid = 0, h = 0 and the reason as a warning, never a margin. /diagnostics shows which delays are
    covered. Theorem 1 covers all delays up to h. The criterion for constant delays covers that h alone if it is
    evaluated at one h. In a search it covers the first window of stable delays to its end.

    The certificate applies to the node's parameters; a rig whose plant or controller has other values is refused, and
    the error names the value. For a level, h includes the delay of the pipe and the hold of the controller.
    """

    @classmethod
    def agreed(cls, params: CertificateParams) -> Mapping[str, Any]:
        """The system, or tank and law."""
        if params.method != "level":
            criterion = {f"certificate/{k}": getattr(params, k) for k in ("method", "mu", "order", "cell_terms")}
            return {**params.agreed(), **criterion}
        tank = {"tank/c": params.c, "tank/x0": params.x0, "tank/model": "nonlinear"}
        return {**law_of_the_tank(params.switch, params.k_low, params.k_high), **tank}

    @classmethod
    def ports(cls, params: CertificateParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Matrices only where there are some."""
        verdict = scalars("verdict", "certificate/verdict", VERDICT, sporadic=True)
        outputs = (params.matrices_port(sporadic=True), verdict) if params.shapes() else (verdict,)
        return (button("certify", "certify", held=True),), outputs

    @staticmethod
    def solve(request: CertificateParams, work: Work) -> Answer:
        """Solve in another process."""
        p = request
        certificate: Certificate | None
        try:
            if p.method == "level":
                certificate = _level(p.h or level_margin(**p.tank), p.tank)
                return Answer(certificate, "" if certificate.valid else "no certificate: the tank may run empty")
            system = p.build()
            if p.h > 0.0:
                certificate = certify(system, p.h, p.criterion)
            else:
                certificate = certified_margin(
                    system,
                    p.criterion,
                    low=p.low,
                    high=p.high,
                    width=p.width,
                    tell=lambda c: work.status(h=c.h, t=c.t, valid=float(c.valid)),
                )
        except NotApplicable as reason:
            return Answer(None, f"not applicable: {reason}")
        return Answer(certificate, "" if certificate is not None and certificate.valid else "no certificate")

    def answer(self, x: AskedState, t: int, result: Result | None, new: bool) -> tuple[AskedState, Mapping[str, Any]]:
        """Publish a new result."""
        if result is None or not new:
            return x, {}
        actual, reason = result.answer if result.answer is not None else (None, "no answer before the limit")
        if reason:
            self.report(Level.WARN, "no_certificate", reason)
        if actual is None:
            return x, {"verdict": (0.0,) * len(VERDICT)}
        smallest = min((e.smallest / max(abs(e.largest), 1e-300) for e in actual.eigenvalues), default=0.0)
        verdict = (actual.h, float(actual.valid), actual.t, smallest, float(len(actual.eigenvalues)))
        if not self.p.shapes():
            return x, {"verdict": verdict}
        if not actual.valid:  # the last iterate is not used
            return x, {"verdict": verdict, "matrices": (0.0,) * int(np.prod(self.p.padded()))}
        return x, {"verdict": verdict, "matrices": self.p.pad(actual.matrices)}

    def health(self, x: AskedState) -> Mapping[str, str]:
        """Describe which matrices are published, and the eigenvalues of the newest certificate."""
        figures = {**super().health(x), "matrices": ", ".join(self.p.shapes())}
        result = x.jobs.result
        actual = result.answer.certificate if result is not None and result.answer else None
        if actual is not None:
            figures |= {"status": actual.status, "seconds": f"{actual.seconds:.3g}", "covers": _covered(actual)}
            figures |= {e.name: f"{e.smallest:.4g} to {e.largest:.4g}" for e in actual.eigenvalues}
        return figures


def _covered(certificate: Certificate) -> str:
    if not certificate.valid:
        return "nothing"
    if certificate.shortest == certificate.h:
        return f"a constant delay of {certificate.h:.6g} s alone, no shorter one"
    return f"delays from {certificate.shortest:.6g} s to {certificate.h:.6g} s, without a gap"


def _level(h: float, tank: Mapping[str, float]) -> Certificate:
    bound = level_bound(h, **tank)
    return Certificate(h, bound.certified, bound.lowest, {}, [], "closed form", 0.0)
