"""The GUPFC's circuit with its operating point, its answers to steps, its waveforms."""

from __future__ import annotations

import cmath
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from softrig_core import Run, simulate
from softrig_power.gupfc import pulses
from softrig_power.gupfc.figures import cycles
from softrig_power.gupfc.flow.power_flow import Diverged, PowerFlow, References, Solution
from softrig_power.gupfc.network import NetworkParams

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLUE, RED, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#444444"
SIGMA = math.radians(172.5)


def one_line(axes: Axes, references: References) -> None:
    """Draw the circuit with its operating point, from the power flow.

    Parameters
    ----------
    axes : Axes
    references : References

    Raises
    ------
    ValueError
        The references have no operating point.
    """
    flow = PowerFlow(NetworkParams()).solve(references)
    if isinstance(flow, Diverged):
        raise ValueError(f"no operating point: mismatch {flow.mismatch:.3g} pu")
    axes.set(xlim=(0.0, 20.0), ylim=(1.2, 9.4))
    axes.axis("off")
    upper, lower = 6.5, 2.5
    for x, name, low, high in ((2.6, "A", lower, upper), (17.4, "B", lower, upper)):
        _bus(axes, x, low - 0.7, high + 0.7, name, flow)
    for y, (left, right), n, current, v in (
        (upper, ("1", "2"), 1, flow.i12, flow.v12),
        (lower, ("3", "4"), 2, flow.i34, flow.v34),
    ):
        _bus(axes, 8.3, y - 0.6, y + 0.6, left, flow)
        _bus(axes, 11.7, y - 0.6, y + 0.6, right, flow)
        for a, b in ((2.6, 8.3), (11.7, 17.4)):
            axes.plot([a, b], [y, y], color=GREY, lw=1.2)
            axes.text(0.5 * (a + b), y - 0.35, "200 km", ha="center", va="top", fontsize=7, color=GREY)
        axes.plot([8.3, 9.4], [y, y], color=GREY, lw=1.2)
        axes.plot([10.6, 11.7], [y, y], color=GREY, lw=1.2)
        _box(axes, 10.0, y, f"series {n}", f"{abs(v):.4f} / {math.degrees(cmath.phase(v)):.2f}°")
        s = flow.bus[right] * current.conjugate()
        axes.annotate("", (14.4, y + 0.28), (12.3, y + 0.28), arrowprops={"arrowstyle": "->", "color": BLUE})
        axes.text(14.55, y + 0.28, f"{s.real:.3f} {s.imag:+.3f}j", va="center", fontsize=8, color=BLUE)
    axes.plot([8.3, 8.3], [upper - 0.6, 4.9], color=GREY, lw=1.2)
    _box(axes, 8.3, 4.5, "shunt", f"{abs(flow.v_sh):.4f} / {math.degrees(cmath.phase(flow.v_sh)):.2f}°")
    axes.text(6.9, 5.35, f"{flow.s_sh.real:.3f} {flow.s_sh.imag:+.3f}j", ha="right", fontsize=8, color=BLUE)
    axes.annotate("", (8.1, 5.75), (8.1, 5.0), arrowprops={"arrowstyle": "->", "color": BLUE})
    # The DC link and its currents.
    axes.plot([8.9, 12.9], [4.5, 4.5], color=RED, lw=2.0)
    axes.plot([10.0, 10.0], [lower + 0.45, upper - 0.45], color=RED, lw=2.0)
    axes.text(12.95, 4.5, f"DC link, v_dc = {abs(flow.v_sh):.4f} pu", va="center", fontsize=8, color=RED)
    for y, p in ((5.4, flow.p12), (3.95, flow.p34)):
        axes.text(10.15, y, f"{p:.4f}", fontsize=8, color=RED, va="center")
    e2, e1 = NetworkParams().sources
    for x, name, v in ((0.8, "source 2", e2), (19.2, "source 1", e1)):
        axes.plot([x, 2.6 if x < 10 else 17.4], [4.5, 4.5], color=GREY, lw=1.2)
        axes.plot(x, 4.5, "o", ms=18, mfc="white", mec=GREY)
        axes.text(x, 4.5, "~", ha="center", va="center", fontsize=12)
        text = f"{name}\n{abs(v):.3f} / {math.degrees(cmath.phase(v)):.1f}°"
        axes.text(x, 3.75, text, ha="center", va="top", fontsize=7)
    text = (
        "Per unit (100 MVA, 230 kV): bus and converter voltages, flows out of buses 2 and 4, power through the DC link"
    )
    axes.text(0.1, 9.3, text, fontsize=8, va="top", color=GREY)


def _bus(axes: Axes, x: float, low: float, high: float, name: str, flow: Solution) -> None:
    v = flow.bus[name]
    axes.plot([x, x], [low, high], color="black", lw=3.0, solid_capstyle="butt")
    text = f"{name}\n{abs(v):.4f} / {math.degrees(cmath.phase(v)):.2f}°"
    axes.text(x, high + 0.1, text, ha="center", va="bottom", fontsize=8)


def _box(axes: Axes, x: float, y: float, name: str, value: str) -> None:
    from matplotlib.patches import Rectangle

    axes.add_patch(Rectangle((x - 0.6, y - 0.42), 1.2, 0.84, fc="white", ec=RED, lw=1.5, zorder=3))
    axes.text(x, y, name, ha="center", va="center", fontsize=7, zorder=4)
    axes.text(
        x,
        y - 0.5,
        value,
        ha="center",
        va="top",
        fontsize=7,
        color=RED,
        zorder=4,
        bbox={"fc": "white", "ec": "none", "pad": 0.5},
    )


def response(figure: Figure, run: Run) -> None:
    """Draw flows with their references, voltages, series voltages and power balance over the run."""
    axes = figure.subplots(2, 2, sharex=True)
    parts = {
        name: run.signals[f"gupfc/status/{name}/position"]
        for name in ("p1", "p2", "q1", "q2", "v1", "v_dc", "p_sh", "p12", "p34")
    }
    for ax, quantity, title in ((axes[0, 0], "p", "Active power, pu"), (axes[0, 1], "q", "Reactive power, pu")):
        for n, colour in ((1, BLUE), (2, RED)):
            ax.plot(*parts[f"{quantity}{n}"], color=colour, lw=1.2, label=f"circuit {n}")
            t, x = run.signals[f"series_{n}/reference/{quantity}/position"]
            ax.step([*t, run.rig.end / 1e9], [*x, x[-1]], "--", where="post", color="#222222", lw=0.8)
        ax.set_title(title)
        ax.legend(frameon=False)
    for name, colour, label in (("v1", BLUE, "bus 1"), ("v_dc", RED, "DC link")):
        axes[1, 0].plot(*parts[name], color=colour, lw=1.2, label=label)
    axes[1, 0].set(title="Voltage, pu", xlabel="s")
    for name, colour, label in (("p_sh", BLUE, "shunt"), ("p12", RED, "series 1"), ("p34", GREEN, "series 2")):
        axes[1, 1].plot(*parts[name], color=colour, lw=1.2, label=label)
    total = sum(parts[name].x for name in ("p_sh", "p12", "p34"))
    axes[1, 1].plot(parts["p_sh"].t, total, color=GREY, lw=0.9, label="sum: DC link")
    axes[1, 1].set(title="Active power that the converters deliver, pu", xlabel="s")
    axes[1, 0].legend(frameon=False)
    axes[1, 1].legend(frameon=False, loc="upper left", bbox_to_anchor=(0.02, 0.82), ncols=2)


def waveforms(figure: Figure, run: Run) -> None:
    """Draw the 48 steps of the shunt voltage, its spectrum, the voltage of bus 1 and the distortion over sigma."""
    axes = figure.subplots(2, 2)
    cycle = 1.0 / 60.0
    v_sh, v12, u1 = (cycles(run.signals, part, cycle, 1) for part in ("v_sh", "v12", "u1"))
    t = np.arange(v_sh.size) / v_sh.size * cycle * 1e3
    axes[0, 0].step(t, v_sh.real, where="post", color=BLUE, lw=1.0, label="shunt, 48 steps")
    axes[0, 0].step(t, v12.real, where="post", color=RED, lw=1.0, label="series 1")
    axes[0, 0].plot(t, u1.real, color=GREEN, lw=0.9, label="bus 1")
    axes[0, 0].set(title="Phase a over the last cycle, pu", xlabel="ms")
    axes[0, 0].legend(frameon=False)
    for wave, colour, label, shift in ((v_sh, BLUE, "shunt", 0.0), (u1, GREEN, "bus 1", 0.8)):
        spectrum = np.abs(np.fft.fft(wave)) / wave.size
        orders = np.arange(2, 101)
        amplitude = np.hypot(spectrum[orders], spectrum[-orders])
        axes[0, 1].bar(orders + shift, 100.0 * amplitude / spectrum[1], width=0.8, color=colour, label=label)
    closed = {n: a / pulses.fundamental(SIGMA) for n, a in pulses.harmonics(SIGMA, 100).items() if n != 1}
    axes[0, 1].plot([abs(n) for n in closed], [100.0 * a for a in closed.values()], "k_", ms=7, label="closed form")
    axes[0, 1].set(title="Harmonics, % of the fundamental", xlabel="order")
    axes[0, 1].legend(frameon=False)
    sigma = np.radians(np.linspace(60.0, 180.0, 481))
    axes[1, 0].plot(np.degrees(sigma), [pulses.distortion(s) for s in sigma], color=BLUE, label="all harmonics")
    axes[1, 0].plot(np.degrees(sigma), [pulses.distortion(s, 50) for s in sigma], color=RED, label="to the 50th")
    axes[1, 0].axhline(4.35, color=GREY, ls="--", lw=0.8)
    axes[1, 0].text(61.0, 4.45, "published: 4.35 %", fontsize=8, color=GREY)
    axes[1, 0].set(title="Distortion of the 48-step voltage, %", xlabel="sigma, deg")
    axes[1, 0].legend(frameon=False)
    for name, colour in (("p1", BLUE), ("p2", RED)):
        axes[1, 1].plot(*run.signals[f"gupfc/status/{name}/position"], color=colour, lw=0.5, label=f"{name}, 48 steps")
    axes[1, 1].set(title="Active power with the 48-step voltages, pu", xlabel="s")
    axes[1, 1].legend(frameon=False)


STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.xmargin": 0.0,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "axes.axisbelow": True,
}


def draw(folder: Path) -> None:
    """Draw all pictures into a folder."""
    with rc_context(STYLE):
        figure = Figure(figsize=(10.0, 4.3), layout="constrained")
        one_line(figure.subplots(), References())
        figure.savefig(folder / "gupfc_one_line.png", dpi=100)
        for name, picture, scenario in (
            ("response", response, "gupfc"),
            ("faster", response, "gupfc_stretch"),
            ("waveforms", waveforms, "gupfc_s2"),
        ):
            figure = Figure(figsize=(10.0, 6.5), layout="constrained")
            picture(figure, simulate(scenario))
            figure.savefig(folder / f"gupfc_{name}.png", dpi=90)
