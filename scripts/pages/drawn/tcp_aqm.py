"""The laws with and without the delay of the loop, and the packet queue's histogram of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from softrig_core import Array, SignalMap, simulate

QUEUE = "network/truth/queue/position"
LAWS = {"SSPD": "", "SSPID": "_sspid", "PI": "_pi", "PID": "_pid"}
PACKETS = {"PI": "", "SSPD": "_sspd", "SSPD, detuned": "_detuned", "robust": "_robust"}


def laws(runs: Mapping[str, tuple[SignalMap, SignalMap]], path: Path) -> None:
    """Draw the queue of each law without and with the delay between command and effect.

    Parameters
    ----------
    runs : mapping
        Name of the law to the signals without and with the delay.
    path : Path
        PNG to write.
    """
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for k, (axis, title) in enumerate(zip(axes, ("as in the paper", "with the delay of a network"), strict=True)):
        for name, pair in runs.items():
            t, q = pair[k][QUEUE]
            axis.plot(t, q, lw=1.0, label=name)
        axis.axhline(120.0, color="k", lw=0.7, ls="--")
        axis.set_title(f"Command acts {title}", fontsize=9)
        axis.set_xlabel("time, s")
    axes[0].set_ylabel("queue, packets")
    axes[1].legend(fontsize=8)
    figure.savefig(path, dpi=110)


def histogram(queues: Mapping[str, Sequence[Array]], path: Path, *, q_max: float = 300.0) -> None:
    """Draw how often each length of the packet queue occurs.

    Parameters
    ----------
    queues : mapping
        Name of the law to the queue (packets) of each seed, settled part only.
    path : Path
        PNG to write.
    q_max : float
        Room in the queue, packets.
    """
    figure = Figure(figsize=(9.0, 3.0), layout="constrained")
    axis = figure.subplots()
    for name, parts in queues.items():
        every = np.concatenate(parts)
        label = f"{name}: {every.mean():.0f} +- {every.std():.0f}"
        axis.hist(every, bins=list(np.arange(0.0, q_max + 5.0, 5.0)), density=True, histtype="step", label=label)
    axis.axvline(120.0, color="k", lw=0.7, ls="--")
    axis.set_xlabel("queue, packets (15 to 30 s, seeds 1 to 5)")
    axis.set_ylabel("density, 1/packet")
    axis.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def draw(folder: Path) -> None:
    """Run the scenarios and draw both pictures into a folder."""
    runs = {
        name: (simulate(f"tcp_aqm_smc{law}").signals, simulate(f"tcp_aqm_smc{law}_delay").signals)
        for name, law in LAWS.items()
    }
    laws(runs, folder / "tcp_aqm_laws.png")
    queues = {}
    for name, law in PACKETS.items():
        results = [simulate(f"tcp_aqm_smc_s4{law}", seed=seed).signals[QUEUE] for seed in range(1, 6)]
        queues[name] = [q[t >= 15.0] for t, q in results]
    histogram(queues, folder / "tcp_aqm_histogram.png")
