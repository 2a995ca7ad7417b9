"""The 48 published cases (Tables II to IV) and the results of the paper's two swarms."""

from __future__ import annotations

from typing import NamedTuple

TYPES = ("ABCG", "AG", "ABG", "AB")
PLACES = (5.0, 50.0, 100.0, 115.0)  # km
LENGTH = 120.0  # km, of the published line

_TABLES = {  # ohm: rows (x by WOA, x by GWO, error of WOA in %, error of GWO in %), types by TYPES, places by PLACES
    0.0: """
        4.9736 4.967 -0.0220 -0.0275   49.4301 49.41 -0.4749 -0.4917
        99.937 98.9034 -0.0525 -0.9138   114.906 114.831 -0.0783 -0.1408
        4.9728 4.9638 -0.0227 -0.0302   49.458 49.4031 -0.4517 -0.4974
        99.941 98.906 -0.0492 -0.9117   114.911 114.794 -0.0742 -0.1717
        4.9731 4.9686 -0.0224 -0.0262   49.461 49.4058 -0.4492 -0.4952
        99.954 98.886 -0.0383 -0.9283   114.908 114.842 -0.0767 -0.1317
        4.9801 4.973 -0.0166 -0.0225   49.851 49.7056 -0.1242 -0.2453
        99.952 98.9171 -0.0400 -0.9024   114.941 114.889 -0.0492 -0.0925""",
    5.0: """
        5.0632 5.136 0.0527 0.1133   50.487 50.497 0.4058 0.4142
        99.799 99.698 -0.1675 -0.2517   115.207 115.226 0.1725 0.1883
        5.2005 5.290 0.1671 0.2417   50.307 50.474 0.2558 0.3950
        99.834 99.588 -0.1383 -0.3433   115.709 115.798 0.5908 0.6650
        5.1837 5.1989 0.1531 0.1658   50.615 50.863 0.5125 0.7192
        99.981 98.895 -0.0158 -0.9208   115.967 115.981 0.8058 0.8175
        4.951 4.869 -0.0408 -0.1092   50.361 50.6101 0.3008 0.5084
        100.83 100.977 0.6917 0.8142   114.583 114.497 -0.3475 -0.4192""",
    15.0: """
        5.2641 5.2798 0.2201 0.2332   50.135 50.261 0.1125 0.2175
        99.893 99.6029 -0.0892 -0.3309   115.14 115.301 0.1167 0.2508
        5.0370 5.1470 0.0308 0.1225   50.218 50.4011 0.1817 0.3342
        100.063 100.264 0.0525 0.2200   115.271 115.740 0.2258 0.6167
        5.1837 5.1989 0.1531 0.1658   50.615 50.863 0.5125 0.7192
        99.981 98.795 -0.0158 -1.0042   115.567 115.605 0.4725 0.5042
        4.6821 4.3979 -0.2649 -0.5018   50.539 50.581 0.4492 0.4842
        100.795 100.890 0.6625 0.7417   114.476 114.364 -0.4367 -0.5300""",
}


class Case(NamedTuple):
    """One row of the tables."""

    type: str
    x_km: float
    rf_ohm: float


class Published(NamedTuple):
    """Published results of a case: places in km, errors in % of the length."""

    woa_km: float
    gwo_km: float
    woa_error: float
    gwo_error: float


def _read() -> dict[Case, Published]:
    result: dict[Case, Published] = {}
    for rf, text in _TABLES.items():
        numbers = [float(word) for word in text.split()]
        rows = [Published(*numbers[k : k + 4]) for k in range(0, len(numbers), 4)]
        keys = [Case(kind, x, rf) for kind in TYPES for x in PLACES]
        result |= dict(zip(keys, rows, strict=True))
    return result


PUBLISHED = _read()
"""The 48 cases in the order of the paper: resistance, type, place."""
