"""Long arrays: what is computed a stretch at a time is, bit for bit, what numpy computes of the whole array."""

import pickle

import numpy as np
import pytest
from softrig_core.judge import measures
from softrig_core.judge.formula import read
from softrig_core.judge.robustness import NotJudged, Record
from softrig_core.wire import long as module
from softrig_core.wire.long import LongArray, elementwise, gathered, true_places

N = 2003
rng = np.random.default_rng(5)
X, Y = rng.standard_normal((2, N)).cumsum(axis=1)
T = 0.001 * np.arange(N)


@pytest.fixture(autouse=True)
def _short(monkeypatch):
    monkeypatch.setattr(module, "STRETCH", 128)  # numpy sums up to 128 numbers without halving


def far(x):
    return LongArray(x.shape[-1], lambda a, b: x[..., a:b])


FUNCTIONS = {
    "sum": lambda x, y: x.sum(),
    "sum of squares": lambda x, y: (x**2).sum(),
    "complex": lambda x, y: ((x + 1j * y) * (y - y.mean())).sum(),
    "mean": lambda x, y: np.mean(x - y),
    "extremes": lambda x, y: (np.abs(x).max(), np.min(y), x.argmin(), np.argmax(y), np.ptp(x), np.fmax.reduce(x)),
    "least from": lambda x, y: np.min(x, initial=-1e3),
    "truths": lambda x, y: ((x > 0).any(), np.all(y < 1e9), np.count_nonzero(x > y)),
    "parts": lambda x, y: (x[-1], x[7], x[40:900][3:], x[:-1] - y[1:], x[np.array([5, -1, 2000, 5])], x[x > y]),
    "reversed": lambda x, y: x[::-1],
    "differences": lambda x, y: np.diff(x, prepend=np.nan, append=1.0),
    "joined": lambda x, y: np.concatenate((x[:3], np.append(y, 2.0))),
    "places": lambda x, y: np.flatnonzero(np.diff(np.sign(x))),
    "choice": lambda x, y: np.where(x > y, x, 0.0),
    "search": lambda x, y: [
        np.searchsorted(np.abs(x).cumsum(), np.abs(y).cumsum(), side) for side in ("left", "right")
    ],
    "found": lambda x, y: [np.searchsorted(module.np.maximum.accumulate(x), 3.0, side) for side in ("left", "right")],
    "indexed": lambda x, y: gathered(x, np.clip(np.floor(np.abs(y)).astype(int), 0, 9)),
    "from the start": lambda x, y: true_places(x * 0 + np.arange(N) < 700),
    "broadcast": lambda x, y: np.minimum.reduce(np.broadcast_to(x, (2, 2, N))[::-1, 0, 5:], axis=-1, keepdims=True),
    "unknown to them": lambda x, y: (np.median(x), x.std(), np.polyfit(x, y, 1), np.cumsum(x), x.reshape(-1, 1)),
    "own": lambda x, y: elementwise(lambda a, b: np.hypot(a, b))(x, y),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_they_compute_as_numpy_does(name):
    whole, by_parts = FUNCTIONS[name](X, Y), FUNCTIONS[name](far(X), far(Y))
    whole, by_parts = (v if isinstance(v, tuple | list) else [v] for v in (whole, by_parts))
    for a, b in zip(whole, by_parts, strict=True):
        assert a == b if isinstance(a, slice) else np.array_equal(a, np.asarray(b), equal_nan=True)


def test_the_first_of_equal_extremes_counts_and_no_number_is_an_extreme():
    x = np.where(np.arange(N) % 500 == 250, 9.0, 0.0)
    assert (far(x).argmax(), far(-x).argmin()) == (250, 250)
    x[1700] = np.nan
    assert far(x).argmax() == x.argmax() == 1700
    assert np.isnan(far(x).max())


def test_a_place_that_does_not_exist_is_an_error():
    for wrong in (N, -N - 1, np.array([0, N])):
        with pytest.raises(IndexError):
            far(X)[wrong]
    with pytest.raises(ValueError, match="fit together"):
        far(X) + np.zeros(5)


def test_another_process_gets_the_numbers():
    whole = pickle.loads(pickle.dumps(far(X) * 2.0))
    assert type(whole) is np.ndarray
    assert np.array_equal(whole, 2.0 * X)


ARGUMENTS = {"reach_time": {"level": 1.0}, "error_settling_time": {"band": 5.0}, "mean_error": {"reference": "r"}}


@pytest.mark.parametrize("name", measures.__all__)
def test_figures_of_long_signals_have_the_same_bits(name):
    figure, every = getattr(measures, name), slice(0, None, 7)
    for arguments in ({}, {"start": 0.0005}, {"start": 0.5, "end": 2.0004}):
        arguments = ARGUMENTS.get(name, {}) | arguments
        for more in ({}, {"reference": "r"}) if "reference" in figure.__annotations__ else ({},):
            values = []
            for kind in (np.asarray, far):
                signals = {"x": (kind(T), kind(X)), "r": (kind(T[every]), kind(Y[every]))}
                values.append(figure(signals, "x", **arguments | more))
            assert values[0] == values[1], (arguments, more)


FORMULAS = (
    "always[0.5, inf] (x * x + y * y <= 900)",
    "always (x > 2 -> eventually[0, 0.3] y < 1)",
    "eventually[0.2, 2.9] (always[0, 0.05] x / y < 0.5)",
    "always not (x > 5 and historically[0, 0.1] y > 0)",
    "always (x > 60 or y < late)",
    "always (x < 9 until[0, 1] y > -9)",
    "always (eventually x > 0)",
)


@pytest.mark.parametrize("text", FORMULAS)
def test_requirements_of_long_signals_have_the_same_margin(text):
    results = []
    late = np.arange(N) < 1300
    for kind in (np.asarray, far):
        samples = {
            "x": kind(X),
            "y": kind(np.where(np.arange(N) == 2222, 0.0, Y)),
            "late": kind(np.where(late, 0.0, X)),
        }
        record = Record(kind(np.rint(T * 1e9)), samples, late={"late": kind(late)}, after=N * 1e6)
        try:
            results.append(record.margin(read(text, dict.fromkeys(samples))[0]))
        except NotJudged as error:
            results.append(str(error))
    assert results[0] == results[1]
