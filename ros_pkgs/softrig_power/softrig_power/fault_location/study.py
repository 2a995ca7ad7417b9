"""Many faults on all cores: the 48 published cases with every method, and disturbed records."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, get_args

import numpy as np
from softrig_core.block.params import build
from softrig_optim.sweep import sweep

from .cases import PUBLISHED, Case
from .line.parameters import RATES, RigParams
from .line.simulation import CHANNELS, FaultedLine
from .method.location import locate
from .method.objective import Algorithm, LocatorParams
from .records.record import Record

METHODS: tuple[str, ...] = get_args(Algorithm)
Settings = Mapping[str, Any]


@dataclass(frozen=True)
class Row:
    """One location: the case, how it was located, and the answer."""

    type: str
    x_km: float
    rf_ohm: float
    method: str
    profile: str
    status: str
    located_km: float | None
    error_percent: float | None
    f_min: float
    f_max: float
    mode: int
    evaluations: int
    cpu_s: float

    @property
    def error_m(self) -> float:
        """Error in m; NaN without a position."""
        return float("nan") if self.located_km is None else 1e3 * (self.located_km - self.x_km)


def simulate(p: RigParams) -> Record:
    """Return the record of both ends, with its noise."""
    line = FaultedLine(p)
    samples = line.run(p.samples)[:, :CHANNELS]
    samples += line.noise(np.random.default_rng(p.measurement.seed), p.samples)
    return Record(0.0, float(RATES[p.measurement.profile]), np.ascontiguousarray(samples))


@lru_cache(maxsize=4)
def _simulated(settings: tuple[tuple[str, Any], ...]) -> Record:
    return simulate(build(RigParams, dict(settings)))  # type: ignore[arg-type]


def run_case(case: Case, rig: Settings, locator: Settings) -> Row:
    """Simulate a fault and locate it.

    Parameters
    ----------
    rig, locator : mapping
        Further parameters of `RigParams` and `LocatorParams` under dotted names.
    """
    settings = dict(rig) | {"fault.type": case.type, "fault.x_km": case.x_km, "fault.rf_ohm": case.rf_ohm}
    p: Any = build(LocatorParams, locator)
    record = _simulated(tuple(sorted(settings.items())))
    begin = time.process_time()
    location = locate(record, p)
    spent = time.process_time() - begin
    error = None if location.x_km is None else 100.0 * (location.x_km - case.x_km) / p.line.length
    profile = str(settings.get("measurement.profile", "m20k"))
    return Row(case.type, case.x_km, case.rf_ohm, p.algorithm, profile, location.status.name.lower(), location.x_km,
               error, location.f_min, location.f_max, location.mode, location.evaluations, spent)  # fmt: skip


Job = tuple[Case, Settings, Settings]


def run(jobs: Sequence[Job], processes: int | None = None) -> list[Row]:
    """Run jobs on all cores; the rows are in the order of the jobs and do not depend on the number of processes.

    Parameters
    ----------
    jobs : sequence of (Case, rig settings, locator settings)
    processes : int, optional
        Worker processes; all cores when absent, 1: in this process.
    """
    return sweep(_run_job, jobs, title="faults", workers=processes)


def _run_job(job: Job) -> Row:
    return run_case(*job)


def published_jobs(methods: Sequence[str] = METHODS, profile: str = "m20k", **locator: Any) -> list[Job]:
    """Return the 48 published cases with each method; travelling waves need the unfiltered record at 1 MHz."""
    result: list[Job] = []
    for case in PUBLISHED:
        for method in methods:
            rate = "raw1m" if method == "travelling_wave" else profile
            result.append((case, {"measurement.profile": rate}, {**locator, "algorithm": method}))
    return result


SENSITIVITY = (Case("AG", 50.0, 0.0), Case("AG", 115.0, 15.0), Case("ABCG", 5.0, 15.0), Case("AB", 100.0, 5.0))
"""The four cases of the sensitivity table."""
NOISE_SEEDS = 10


def disturbances() -> Iterator[tuple[str, Settings, Settings]]:
    """Yield the change of each row of the sensitivity table: name, rig settings, locator settings."""
    l1, r1 = LocatorParams().line.l1, LocatorParams().line.r1
    yield "none", {}, {}
    for us in (1.0, 10.0, -1.0, -10.0):
        yield f"R end late by {us:g} us", {"measurement.shift_us_r": us}, {}
    yield "u_S +0.5 %", {"measurement.ratio_err.u_s": 0.005}, {}
    yield "i_R +0.5 %", {"measurement.ratio_err.i_r": 0.005}, {}
    yield "L1 +1 %", {}, {"line.l1": 1.01 * l1}
    yield "R1 doubled", {}, {"line.r1": 2.0 * r1}
    yield "R1 = 0", {}, {"line.r1": 0.0}


def sensitivity(mode: str = "auto", processes: int | None = None) -> dict[str, list[float]]:
    """Return the sensitivity table: errors in m of the four cases by disturbance; of noise the standard deviation."""
    rows = [(name, case, rig, {**loc, "mode": mode}) for name, rig, loc in disturbances() for case in SENSITIVITY]
    for snr in (60.0, 40.0, 30.0):
        rows += [
            (f"SNR {snr:g} dB, std", case, {"measurement.noise_snr_db": snr, "measurement.seed": seed}, {"mode": mode})
            for case in SENSITIVITY
            for seed in range(NOISE_SEEDS)
        ]
    result = run([(case, rig, loc) for _, case, rig, loc in rows], processes)
    table: dict[str, dict[Case, list[float]]] = {}
    for (name, case, _, _), row in zip(rows, result, strict=True):
        table.setdefault(name, {}).setdefault(case, []).append(row.error_m)
    return {name: [e[0] if len(e) == 1 else float(np.std(e)) for e in cases.values()] for name, cases in table.items()}


def as_csv(rows: Sequence[Row]) -> str:
    """Return rows as CSV with a header."""
    lines = [",".join(asdict(rows[0]))]
    lines += [",".join("" if v is None else str(v) for v in asdict(row).values()) for row in rows]
    return "\n".join(lines) + "\n"
