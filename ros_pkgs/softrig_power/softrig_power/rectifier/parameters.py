"""Constants of the 10 kW rectifier and its exact operating point."""

from __future__ import annotations

import math

from softrig_core import Params, param


class RectifierConstants(Params):
    """Grid, filter, DC link and nominal load of the paper (its table of parameters)."""

    V_g: float = param(180.0, "grid phase amplitude (peak)", "V", gt=0.0, le=1e4)
    f: float = param(60.0, "grid frequency", "Hz", ge=1.0, le=1000.0)
    L: float = param(1.93e-3, "filter inductance of a phase", "H", gt=0.0, le=1.0)
    R: float = param(0.1, "filter resistance of a phase", "ohm", gt=0.0, le=100.0)
    C: float = param(990e-6, "DC-link capacitance", "F", gt=0.0, le=1.0)
    R_L: float = param(16.0, "load resistance", "ohm", gt=0.0, le=1e6)
    v_ref: float = param(400.0, "DC voltage of the operating point", "V", gt=0.0, le=1e4)

    @property
    def omega(self) -> float:
        """Angular frequency of the grid in rad/s."""
        return 2.0 * math.pi * self.f

    @property
    def impedance(self) -> float:
        """|R + j omega L| in ohm."""
        return math.hypot(self.R, self.omega * self.L)

    @property
    def phi(self) -> float:
        """Angle of R + j omega L in rad."""
        return math.atan2(self.omega * self.L, self.R)

    @property
    def current(self) -> float:
        """Peak phase current I in A at unity power factor: 1.5 (V_g I - R I^2) = v_ref^2/R_L.

        Raises
        ------
        ValueError
            The grid cannot carry this load through R.
        """
        power = self.v_ref**2 / self.R_L
        root = self.V_g**2 - 4.0 * self.R * power / 1.5
        if root < 0.0:
            raise ValueError(f"R_L = {self.R_L:g} ohm takes {power:g} W, more than V_g^2/(4 R) allows")
        return (self.V_g - math.sqrt(root)) / (2.0 * self.R)

    @property
    def drop(self) -> float:
        """V' in V: amplitude of the drop across R + j omega L at the operating point."""
        return self.impedance * self.current
