"""Load steps, limit cycles, horizons and models, phase currents and their spectrum."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from softrig_core import Array, simulate
from softrig_power.rectifier.parameters import RectifierConstants
from softrig_power.rectifier.ports import WAVEFORM_CHANNELS

if TYPE_CHECKING:
    from matplotlib.axes import Axes


STEPS = {
    "rectifier_mpc_n1": "x 1.25",
    "rectifier_mpc_n1_x1p5": "x 1.5",
    "rectifier_mpc": "x 2",
    "rectifier_mpc_n1_x2p5": "x 2.5",
}
DECOUPLED = {
    "rectifier_mpc_decoupled_x1p25": "x 1.25",
    "rectifier_mpc_decoupled_x1p5": "x 1.5",
    "rectifier_mpc_decoupled": "x 2",
    "rectifier_mpc_decoupled_x2p5": "x 2.5",
}
HORIZONS = {f"rectifier_mpc_l3{'' if n == 11 else f'_np{n}'}": f"Np = {n}" for n in (3, 5, 8, 11, 15, 20, 30)}
PERIODS = {
    "rectifier_mpc_l2_0p1ms": "0.1 ms",
    "rectifier_mpc_l2_0p2ms": "0.2 ms",
    "rectifier_mpc_l2": "0.83 ms",
    "rectifier_mpc_l2_2ms": "2 ms (lambda 1)",
}
MODELS = {
    "rectifier_mpc_seed19_lam1": "(19), lambda 1",
    "rectifier_mpc_seed19_lam500": "(19), lambda 500",
    "rectifier_mpc_seed19": "(19), lambda 5000",
    "rectifier_mpc_n1": "corrected model, lambda 500",
}


def waveform(scenario: str, substep: float = 2e-6) -> tuple[Array, dict[str, Array]]:
    """Run a scenario with waveforms.

    Returns
    -------
    t : (n,) ndarray
        Times in s, `substep` apart.
    signals : dict of str to (n,) ndarray
        By `WAVEFORM_CHANNELS`.
    """
    run = simulate(scenario, overrides={"rectifier_plant.waveform": True, "rectifier_plant.substep": substep})
    columns = np.column_stack(list(run.signals.table("waveform").columns.values()))[1:]
    rows = columns.reshape(-1, len(WAVEFORM_CHANNELS))
    period = run.rig.clock.params.period
    h = period * len(columns) / len(rows)
    t: Array = h * np.arange(1.0, len(rows) + 1.0)
    return t, dict(zip(WAVEFORM_CHANNELS, rows.T, strict=True))


def spectrum(t: Array, x: Array, cycles: int, f: float) -> tuple[Array, Array]:
    """Return frequencies (Hz) and amplitudes (peak) over the last whole cycles."""
    h = float(t[1] - t[0])
    n = round(cycles / f / h)
    return np.asarray(np.fft.rfftfreq(n, h), dtype=np.float64), np.abs(np.fft.rfft(x[-n:])) * 2.0 / n


def family(axes: Axes, runs: Mapping[str, str], signal: str, band: float = 8.0, scale: float = 1.0) -> None:
    """Draw one signal of many scenarios with the settling band around 400 V."""
    axes.axhspan(400.0 - band, 400.0 + band, color="0.9", label="2 % band")
    for name, label in runs.items():
        t, x = simulate(name).signals[signal]
        axes.plot(t * scale, x, label=label, linewidth=1.0)
    axes.set_ylabel("DC voltage in V")
    axes.set_xlabel("time in ms" if scale > 1.0 else "time in s")
    axes.legend(fontsize="small")


def load_steps(figure: Any) -> None:
    """DC voltage after load steps: the paper's structure and the decoupled one."""
    for axes, runs, title in zip(
        figure.subplots(1, 2, sharey=True), (STEPS, DECOUPLED), ("sensorless", "decoupled"), strict=True
    ):
        family(axes, runs, "dc_link/voltage/position")
        axes.set(xlim=(0.14, 0.22), title=f"Load step, {title}")


def limit_cycle(figure: Any) -> None:
    """Draw the effect of the paper's model on the plant."""
    axes = figure.subplots()
    family(axes, MODELS, "dc_link/voltage/position")
    axes.set(title="Load x 1.25 under GPC on the paper's (19) and on the corrected model", xlim=(0.1, 0.6))


def studies(figure: Any) -> None:
    """Horizon and sampling time on (19)."""
    for axes, runs, title in zip(
        figure.subplots(1, 2),
        (HORIZONS, PERIODS),
        ("Prediction horizon, lambda 18.6", "Sampling time, lambda 17.873"),
        strict=True,
    ):
        family(axes, runs, "output/v_dc/position", scale=1e3)
        axes.set(xlim=(0, 40), ylim=(-50, 700), title=title)


def current(figure: Any) -> None:
    """Grid current against grid voltage of phase a, clean and with a fifth harmonic."""
    names = {
        "rectifier_mpc_n4": "10 kHz carrier",
        "rectifier_mpc_n3_switched": "fifth harmonic of 36 V",
        "rectifier_mpc_n3_instantaneous": "the same, fed forward",
    }
    for axes, (name, title) in zip(figure.subplots(3, 1, sharex=True), names.items(), strict=True):
        t, x = waveform(name)
        inside = (t > 0.35) & (t < 0.4)
        axes.plot(t[inside], x["v_ga"][inside], label="grid voltage in V", linewidth=1.0)
        axes.plot(t[inside], x["i_a"][inside], label="grid current in A", linewidth=0.8)
        axes.set_title(title)
        axes.legend(fontsize="small", loc="upper right")
    axes.set_xlabel("time in s")


def harmonics(figure: Any) -> None:
    """Spectrum of the grid current with its lines named."""
    f, carrier = RectifierConstants().f, 1e4
    upper, lower = figure.subplots(2, 1)
    order, amplitude = spectrum(*_phase_a("rectifier_mpc_n4"), 6, f)
    upper.semilogy(order / 1e3, np.maximum(amplitude, 1e-4), linewidth=0.8)
    named = {
        f: f"{f:g} Hz",
        carrier - 2 * f: "fc - 2f",
        carrier + 2 * f: "fc + 2f",
        2 * carrier - f: "2fc - f",
        2 * carrier + f: "2fc + f",
        3 * carrier - 2 * f: "3fc - 2f",
    }
    for at, name in named.items():
        y = amplitude[np.argmin(np.abs(order - at))]
        upper.annotate(
            name, (at / 1e3, y), textcoords="offset points", xytext=(-30 if "-" in name else 4, 4), fontsize="small"
        )
    upper.set(xlim=(0, 45), ylim=(1e-3, 100), xlabel="kHz", ylabel="A peak", title="Grid current, 10 kHz carrier")
    for name, label, shift in (
        ("rectifier_mpc_n3_switched", "fundamental only", -0.2),
        ("rectifier_mpc_n3_instantaneous", "harmonic fed forward", 0.2),
    ):
        order, amplitude = spectrum(*_phase_a(name), 6, f)
        lower.bar(np.arange(2, 20) + shift, amplitude[12:120:6], 0.4, label=label)
    lower.set(xlabel="order", ylabel="A peak", title="Grid current under a fifth harmonic of 36 V", xticks=range(2, 20))
    lower.legend(fontsize="small")


def _phase_a(scenario: str) -> tuple[Array, Array]:
    t, x = waveform(scenario)
    return t, x["i_a"]


PICTURES = {
    "load_steps": load_steps,
    "limit_cycle": limit_cycle,
    "studies": studies,
    "current": current,
    "spectrum": harmonics,
}


def draw(folder: Path) -> None:
    """Draw all pictures into a folder."""
    for name, picture in PICTURES.items():
        figure = Figure(figsize=(10, 6.5 if name in ("current", "spectrum") else 4.2), layout="constrained")
        picture(figure)
        figure.savefig(folder / f"rectifier_mpc_{name}.png", dpi=90)
