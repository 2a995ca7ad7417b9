"""Maximum power point tracking: the optimiser on the duty of the converter."""

from __future__ import annotations

from typing import Literal

import numpy as np
from softrig_core import Port, command, param
from softrig_optim.falling import FallingCurve
from softrig_optim.load_line import CertifiedSearch, RampScan
from softrig_optim.optimiser import CommandOptimiser, SearchParams, buttons, state_port
from softrig_optim.search import Point, Search

from ..baselines.algorithms import Algorithm, make
from .converter import BuckBoostMatching
from .ports import array_port

Tracker = Literal["certified", "certified_transients", "ramp"]
INPUTS = array_port("measurement"), *buttons("mppt")
STATUS = state_port("mppt/status", {"duty": ""})


class MpptParams(SearchParams):
    """Parameters of the tracker, none of which belongs to the plant."""

    algorithm: Algorithm | Tracker = param("issa", "name of the algorithm")
    c3_threshold: float = param(0.5, "issa, ssa: the leader goes up if c3 is not below; misprint 0", ge=0.0, le=1.0)
    d_min: float = param(0.1, "lower limit of the duty", gt=0.0, lt=1.0)
    d_max: float = param(0.9, "upper limit of the duty", gt=0.0, lt=1.0)
    duty_slew: float = param(0.0, "most change of the duty in a second; 0: no limit", "1/s", ge=0.0, live=True)
    eps: float = param(0.01, "certified: relative gap to prove", gt=0.0)
    ramp_time: float = param(0.12, "ramp: duration of the sweep", "s", gt=0.0)
    floor: float | None = param(
        0.1,
        "power not above this, at a current not above a tenth of it in A, is darkness: no "
        "search, another one in the light",
        "W",
        live=True,
    )

    def _check(self) -> None:
        if self.d_min >= self.d_max:
            raise ValueError(f"d_min = {self.d_min:g} is not below d_max = {self.d_max:g}")
        self.search(np.random.default_rng(0))

    def search(self, rng: np.random.Generator) -> Search:
        """Create a search."""
        lower, upper, matching = (self.d_min,), (self.d_max,), BuckBoostMatching()
        match self.algorithm:
            case "certified" | "certified_transients":
                transients = self.algorithm == "certified_transients"
                return CertifiedSearch(
                    lower, upper, matching=matching, eps=self.eps, transients=transients, budget=self.budget
                )
            case "ramp":
                n_ramp = round(self.ramp_time / self.period)
                return RampScan(lower, upper, matching=matching, n_ramp=n_ramp, budget=self.budget)
            case algorithm:
                return make(algorithm, lower, upper, rng, self, maximise=True, c3_threshold=self.c3_threshold)


class MpptOptimiser(CommandOptimiser[MpptParams]):
    """Tracker of the maximum power point; sees only voltage and current of the string.

    See `CommandOptimiser` for when it searches and restarts, `softrig_optim` and `baselines` for the algorithms.
    """

    @classmethod
    def ports(cls, params: MpptParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """The duty; near open circuit without a measurement."""
        return INPUTS, (command("command", "converter/duty", ("duty",), "1", safe=(params.d_min,)), STATUS)

    def objective(self, sample: Point) -> float:
        """The power in W."""
        return sample[0] * sample[1]

    def no_signal(self, sample: Point, value: float) -> bool:
        """Return whether neither power nor current is measured: in dim light a large duty has little power, but
        all current.
        """
        return super().no_signal(sample, value) and sample[1] <= 0.1 * (self.p.floor or 0.0)

    def characteristic(self, n: int) -> FallingCurve:
        """Detect another irradiance, unless all later measurements are unchanged: the rescan finds that."""
        return FallingCurve(n)

    def slew(self) -> float:
        """Return the rate of the parameter."""
        return self.p.duty_slew
