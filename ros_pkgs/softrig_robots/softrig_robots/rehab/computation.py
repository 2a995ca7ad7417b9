"""Computation time of the control laws, the paper's index ACT: ``python -m softrig_robots.rehab.computation``."""

from __future__ import annotations

import time
from math import sin
from typing import Any

from .controller import LAWS, VoltageController

PUBLISHED = {"emvc": 12.2, "tsarc": 37.8, "arsc": 160.0}  # us, Table II
UPDATES = 20_000
ROUNDS = 3


def computation_times(updates: int = UPDATES) -> dict[str, float]:
    """Return the mean CPU time of one update of `VoltageController`, both joints, with each law.

    Parameters
    ----------
    updates : int
        Number of updates over which one round averages.

    Returns
    -------
    dict
        Law to us, the best of three rounds.
    """
    results: dict[str, list[float]] = {law: [] for law in LAWS}
    for _ in range(ROUNDS):  # law after law, so that a slow minute of the host meets all of them
        for law, times in results.items():
            times.append(_mean_time(VoltageController(law=law), updates))
    return {law: min(times) for law, times in results.items()}


def _mean_time(controller: VoltageController, updates: int) -> float:
    """Mean time of an update in us, over states that change."""
    ticks: list[dict[str, Any]] = []
    for k in range(updates):
        x = sin(1e-3 * k)
        ticks.append(
            {
                "joint_states": (x, -x, 0.2, -0.1),
                "motor_states": (0.1 * x, 0.2),
                "reference": (x + 0.01, 0.01 - x, 0.2, -0.1, 0.0, x),
                "applied_voltage": (x, -x),
            }
        )
    state = controller.first()
    start = time.process_time()
    for k, inputs in enumerate(ticks):
        state, _ = controller.update(state, k, **inputs)
    return (time.process_time() - start) / updates * 1e6


def main() -> None:
    """Print the times beside the paper's."""
    print("ACT, us   paper   here")
    for law, result in computation_times().items():
        print(f"{law:8} {PUBLISHED[law]:6.1f} {result:6.2f}")


if __name__ == "__main__":
    main()
