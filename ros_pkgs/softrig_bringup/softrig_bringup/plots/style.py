"""Style of pictures: colours, sizes, units and printed axis titles."""

from __future__ import annotations

from typing import Any, NamedTuple

from softrig_core.judge.units import pretty_unit

# Okabe and Ito's colours, which stay apart for every kind of colour vision; yellow is left out (too pale on white).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f5539")
REFERENCE = "#222222"
VIOLATED = "#cc3311"  # colour of spans in which a requirement does not hold
ACCEPTED = "#44aa99"  # colour of the band of values that pass
PUBLISHED = "#882255"  # colour of the values of the paper
SOFT = "#777777"
DASHED = ((0, (5, 3)), (0, (1.5, 1.5)), (0, (8, 2, 1.5, 2)))
DPI = 110
WIDTH = 10.0  # inch: 1100 pixels, the width of the report's column
MANY = 8  # more curves than this in one axes get a colour scale instead of a legend


class Paper(NamedTuple):
    """Requirements of a publisher for a picture.

    Parameters
    ----------
    widths : tuple of float
        Of one and of two columns, mm.
    font : float
        Size of the letters, points.
    serif : bool
        Whether they are like Times.
    """

    widths: tuple[float, float]
    font: float
    serif: bool


class Style(NamedTuple):
    """Requests for a picture drawn by matplotlib.

    Parameters
    ----------
    title : bool
        Whether it has its title.
    font : float, optional
        Size of the letters, points.
    inches : float, optional
        Width; the height follows, not below what the rows need.
    serif : bool
        Letters like Times.
    """

    title: bool = True
    font: float | None = None
    inches: float | None = None
    serif: bool = False

    @property
    def letters(self) -> int:
        """Return how many letters of a legend fit into its width."""
        return int(110 * (self.inches or WIDTH) / WIDTH * 9.0 / (self.font or 9.0))


PLAIN = Style()  # the style of pages

# the widths are those of the publishers' instructions for artwork
PAPERS = {
    "ieee": Paper((88.9, 182.0), 8.0, True),
    "elsevier": Paper((90.0, 190.0), 8.0, False),
    "springer": Paper((84.0, 174.0), 8.0, False),
    "serif": Paper((120.0, 160.0), 10.0, True),
}
# Type 3 letters, matplotlib's default, are refused by many publishers' checks
FONTS: dict[Any, Any] = {"pdf.fonttype": 42, "ps.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "softrig"}
SERIF: dict[Any, Any] = {"font.family": "STIXGeneral", "mathtext.fontset": "stix"}  # fonts that matplotlib includes


def style() -> dict[Any, Any]:
    """Return matplotlib's settings for every picture of the suite."""
    from matplotlib.rcsetup import cycler

    return FONTS | {
        "font.size": 10.0,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.edgecolor": "#666666",
        "axes.formatter.useoffset": False,
        "axes.formatter.limits": (-3, 5),
        "axes.prop_cycle": cycler(color=COLOURS),
        "axes.spines.right": False,
        "axes.spines.top": False,
        "axes.xmargin": 0.0,
        "figure.facecolor": "white",
        "grid.color": "#dddddd",
        "grid.linewidth": 0.6,
        "legend.borderaxespad": 0.3,
        "legend.borderpad": 0.0,
        "legend.frameon": False,
        "legend.handlelength": 1.6,
        "lines.linewidth": 1.4,
        "lines.solid_joinstyle": "round",
        "xtick.color": "#444444",
        "ytick.color": "#444444",
    }


_UNITS = {
    "Acceleration": "rad/s^2 m/s^2 mm/s^2", "Angle": "rad deg", "Cost": "$/h", "Current": "A kA", "Energy": "J",
    "Flux linkage": "Wb", "Force": "N", "Frequency": "Hz", "Irradiance": "W/m^2", "Mass flow": "kg/s",
    "Position": "m mm", "Power": "W kW MW", "Resistance": "ohm", "Speed": "rad/s rpm m/s mm/s", "Temperature": "K degC",
    "Time": "s", "Voltage": "V kV",
}  # fmt: skip
_QUANTITIES = {unit: name for name, units in _UNITS.items() for unit in units.split()} | {"N m": "Torque"}


def quantity(unit: str) -> str:
    """Return the quantity that a unit of the suite measures; empty if it may be several."""
    return _QUANTITIES.get(unit, "")


def axis_title(name: str, unit: str) -> str:
    """Write an axis title: quantity and unit.

    Examples
    --------
    >>> axis_title("speed", "rad/s^2")
    'Speed, rad/s²'
    """
    words = name[1:2].islower() and not set(name) & set("._/")  # "speed", but not "iA", "q" or a name in code
    title = name[:1].upper() + name[1:] if words else name
    return ", ".join(part for part in (title, pretty_unit(unit)) if part)
