"""The DC-voltage controller: GPC with one of the rectifier's models."""

from __future__ import annotations

from typing import Literal

from softrig_control.predictive.carima import Carima
from softrig_control.predictive.controller import GpcController, GpcLawParams
from softrig_core import param

from .models import d2, n3, seed19
from .parameters import RectifierConstants


class RectifierGpcParams(RectifierConstants, GpcLawParams):
    """Model, weight, bounds, trips and signals of the rectifier."""

    period: float = param(0.00083, "control period T", "s", gt=0.0, le=0.1)
    model: Literal["seed19", "n3", "d2"] = param(
        "n3", "the paper's (19), its corrected form, or that of the decoupled structure"
    )
    lam: float = param(500.0, "weight lambda of the moves; the paper gives none", ge=0.0, le=1e12, live=True)
    u_min: float = param(-40.0, "smallest command", ge=-1e12, le=1e12, live=True)
    u_max: float = param(90.0, "largest command", ge=-1e12, le=1e12, live=True)
    set_point: float = param(400.0, "reference until one arrives", "V", ge=0.0, le=1e4, live=True)
    i_start: float | None = param(
        None,
        "phase current (peak) at the start, which the first command carries on; that "
        "of the operating point when absent",
        "A",
        ge=-1e4,
        le=1e4,
    )
    trip_low: float = param(50.0, "DC voltage at or below which the law trips", "V", ge=-1e12, le=1e12, live=True)
    trip_high: float = param(600.0, "DC voltage above which the law trips", "V", ge=-1e12, le=1e12, live=True)
    measured: str = param("dc_link/voltage/position", "signal under control, topic/channel/field")
    measured_also: tuple[str, ...] = param(
        ("current",), "channels that come in the same message as the measured signal"
    )
    command: str = param("v_drop/command/v_drop/effort", "signal that is commanded, topic/channel/field")

    def carima(self) -> Carima:
        """Return the model by its name."""
        if self.model == "seed19":
            return seed19(self.period)
        return (n3 if self.model == "n3" else d2)(self, self.period)

    @property
    def u_first(self) -> float:
        """Return the current itself, or its voltage drop |R + j omega L| i."""
        current = self.current if self.i_start is None else self.i_start
        return current if self.model == "d2" else self.impedance * current


class RectifierGpc(GpcController[RectifierGpcParams]):
    """Holds the DC voltage by the drop V', or by the current of the decoupled structure; see `GpcController`.

    A trip commands 0: the plant's switches go off, and the diodes alone determine the voltage of the link.
    """
