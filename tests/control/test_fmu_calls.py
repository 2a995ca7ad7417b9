"""How an FMU is called, against a stand-in that records each call: by the state machines of FMI, with precomputed
numbers.
"""

import sys
from itertools import pairwise
from types import ModuleType, SimpleNamespace

import pytest
from expected_text import check_expected
from softrig_control.fmu.instance import Instance, Plan, Refusal

# The result of an event: no further round, no end, no values changed, no next event.
NOTHING = (False, False, False, False, False, 0.0)

ALIKE = {"getContinuousStateDerivatives": "getDerivatives", "updateDiscreteStates": "newDiscreteStates",
         "getInteger": "getReal", "getInt32": "getReal", "getBoolean": "getReal",
         "serializeFMUstate": "serializeFMUState", "deSerializeFMUstate": "deserializeFMUState"}  # fmt: skip


def word(x):
    if hasattr(x, "_length_"):  # a ctypes array
        return word(list(x))
    return f"[{' '.join(map(word, x))}]" if isinstance(x, list) else f"{x:.6g}" if isinstance(x, float) else repr(x)


class Played:
    """An FMU whose methods record their calls and return prepared answers, in that order."""

    def __init__(self, three, slope=lambda t, x: [-x[0]], x=(1.0,), **answers):
        self.calls, self.answers, self.t, self.x = [], {k: [*v] for k, v in answers.items()}, 0.0, [*x]
        self._slope, self._three, self.edge = slope, three, 0.7

    def __getattr__(self, name):
        if name.startswith("_"):
            raise AttributeError(name)

        def called(*arguments, **named):
            result = self.answers[name].pop(0) if self.answers.get(name) else None
            if result is None:
                result = getattr(self, f"_{ALIKE.get(name, name)}", lambda *_, **__: None)(*arguments)
            # Logs the text after the call, with the values it has written.
            words = [*map(word, arguments), *(f"{k}={word(v)}" for k, v in named.items())]
            self.calls.append(f"{name}({', '.join(words)})")
            if isinstance(result, Exception):
                raise result
            return result

        return called

    def _setTime(self, t):
        self.t = t

    def _setContinuousStates(self, x, n):
        self.x = list(x)[:n]

    def _getContinuousStates(self, x, n):
        x[:n] = self.x

    def _getDerivatives(self, dx, n):
        dx[:n] = self._slope(self.t, self.x)

    def _getEventIndicators(self, z, n):
        z[:n] = [self.x[0] - self.edge]

    def _getNumberOfContinuousStates(self):
        return len(self.x)

    def _getNumberOfEventIndicators(self):
        return 1

    def _newDiscreteStates(self):
        return NOTHING

    def _completedIntegratorStep(self):
        return False, False

    def _doStep(self, t, h):
        return (False, False, False, t + h) if self._three else None

    def _getReal(self, references):
        return [float(r) for r in references]

    def _getFloat64(self, references, count=None):
        return [10.0 * k for k in range(count or len(references))]

    def _getFMUState(self):
        return "state"

    def _serializeFMUState(self, _):
        return bytearray(b"bytes")

    def _deserializeFMUState(self, _):
        return "restored"


@pytest.fixture
def played(monkeypatch):
    """Make an `Instance` of a stand-in FMU and return both; calls to FMPy are recorded, too."""

    def make(version, exchange=False, steps=1, outputs=(), inputs=(), start=(), log=False, tolerance=None, **about):
        fmu = Played(version == 3, **about)
        experiment = SimpleNamespace(tolerance=tolerance) if tolerance != "" else None
        model = SimpleNamespace(
            fmiVersion=f"{version}.0",
            defaultExperiment=experiment,
            numberOfContinuousStates=len(fmu.x),
            numberOfEventIndicators=1,
        )

        def instantiated(folder, arguments, kind, *, debug_logging, logger):
            assert arguments is model
            fmu.calls.append(f"instantiate {folder} {kind}{' logging' * debug_logging}")
            fmu.logger = logger
            return fmu

        fmpy, simulation = ModuleType("fmpy"), ModuleType("fmpy.simulation")
        fmpy.read_model_description = lambda folder, validate: model if (folder, validate) == ("here", False) else None
        simulation.instantiate_fmu = instantiated
        monkeypatch.setitem(sys.modules, "fmpy", fmpy)
        monkeypatch.setitem(sys.modules, "fmpy.simulation", simulation)
        return Instance(Plan("here", exchange, inputs, outputs, start, steps, log)), fmu

    return make


# One real number, two elements of an array of three, one integer and one switch.
TWO = {
    "inputs": (("Real", 1, 0, 1), ("Integer", 2, 0, 1), ("Boolean", 3, 0, 1), ("Real", 4, 0, 1)),
    "outputs": (("Real", 7, 0, 1), ("Boolean", 9, 0, 1), ("Real", 8, 0, 1)),
    "start": (("Real", 5, (0.25,)), ("String", 6, ("name",))),
}
THREE = {
    "inputs": (
        ("Float64", 1, 2, 3),
        ("Int32", 2, 0, 1),
        ("Boolean", 3, 0, 1),
        ("Float64", 4, 0, 1),
        ("Float64", 1, 0, 3),
    ),
    "outputs": (("Float64", 7, 1, 3), ("Boolean", 9, 0, 1), ("Float64", 8, 0, 1), ("Float64", 7, 2, 3)),
    "start": (("Float64", 5, (0.25, 0.5)), ("String", 6, ("name",))),
}
VALUES = (1.5, 4.0, 1.0, 2.5, 3.5)


def call_lines(played):
    for version, sides in ((2, TWO), (3, THREE)):
        update = "updateDiscreteStates" if version == 3 else "newDiscreteStates"
        for exchange in (False, True):
            events = {}
            if exchange:  # two rounds at the start, a time event at 0.7 s, and one requested by the integrator step
                events[update] = [(True, *NOTHING[1:]), (*NOTHING[:4], True, 0.7), (*NOTHING[:4], True, 0.7)]
                events["completedIntegratorStep"] = [(False, False), (True, False)]
            one, fmu = played(version, exchange, 2, tolerance="1e-4", log=exchange, **sides, **events)
            values = VALUES[: len(sides["inputs"])]
            for what, call, arguments in (
                ("begin", one.begin, ()),
                ("from 0.5 to 1 s", one.advance, (0.5, 1.0, values)),
                ("a parameter", one.tune, ([("Real", 5, (0.75,))],)),
                ("keep", one.keep, ()),
                ("restore", one.restore, (b"bytes",)),
                ("begin anew", one.begin, ()),
            ):
                if exchange and what == "keep":  # from here on model exchange makes the same calls
                    break
                fmu.calls.clear()
                answer = call(*arguments)
                yield f"FMI {version}.0, {'model exchange' if exchange else 'co-simulation'}: {what}"
                yield from (f"  {call}" for call in fmu.calls)
                yield f"  -> {word(list(answer or [])) if not isinstance(answer, bytes) else answer}"


def test_calls_are_as_expected(played):
    """At the start x = 1; it decays, and below 0.7, which is an event, within the last quarter second."""
    check_expected("fmu/calls", call_lines(played))


def classical(f, a, b, x):
    """One step of the Runge-Kutta method of fourth order by its tableau."""
    h, slopes = b - a, []
    for c, row in ((0, ()), (0.5, (0.5,)), (0.5, (0, 0.5)), (1, (0, 0, 1))):
        y = [u + h * sum((w * k[i] for w, k in zip(row, slopes, strict=True)), 0) for i, u in enumerate(x)]
        slopes.append(f(a + c * h, y))
    return [u + h * sum(w * k[i] for w, k in zip((1, 2, 2, 1), slopes, strict=True)) / 6 for i, u in enumerate(x)]


@pytest.mark.parametrize("version", [2, 3])
def test_the_integrator_is_the_classical_one_cut_at_time_events(played, version):
    def slope(t, x):
        return [x[1] + t * t, 3 * t - x[0] * x[1]]

    update = "updateDiscreteStates" if version == 3 else "newDiscreteStates"
    # Time events requested at the start, at jumps of inputs and at events. An event requested for the present time
    # must not remove one.
    asked = (5 / 16, None, 5 / 16, 5 / 16, 8 / 16, None)
    at = {update: [NOTHING if t is None else (*NOTHING[:4], True, t) for t in asked]}
    one, fmu = played(version, True, 2, slope=slope, x=(0.75, 1.25), **at)
    one.begin()
    x = [0.75, 1.25]
    # In sixteenths of a second. The events are at 5 and at 8, where the integrator step ends anyway.
    for begin, end, cuts in ((0, 4, (0, 2, 4)), (4, 12, (4, 5, 8, 12))):
        one.advance(begin / 16, end / 16, ())
        for a, b in pairwise(cuts):
            x = classical(slope, a / 16, b / 16, x)
        assert fmu.x == pytest.approx(x, rel=1e-13)
    assert [c for c in fmu.calls if "completed" in c] == ["completedIntegratorStep()"] * 5


def test_an_indicator_that_reaches_zero_is_an_event(played):
    """It was above zero before; from zero on, and below, there is no further event."""
    one, fmu = played(2, True, slope=lambda t, x: [-2.0])
    fmu.edge = 0.5
    one.begin()
    # One event for the jump of the inputs, and one for x = 0.5 at the end of the second step.
    for k, events in enumerate((1, 2, 1)):
        fmu.calls.clear()
        one.advance(k / 8, (k + 1) / 8, ())
        assert fmu.calls.count("enterEventMode()") == events
    assert fmu.x == [0.25]


class FMICallException(Exception):  # FMPy's class of the same name
    def __init__(self, function, status):
        super().__init__(function)
        self.function, self.status = function, status


DISCARDED = FMICallException("fmi2DoStep", 2)


@pytest.mark.parametrize(
    ("version", "exchange", "answers", "text"),
    [
        (3, False, {"doStep": [(False, True, False, 0.25)]}, "fmi3DoStep: asks to end the simulation at 0.25 s"),
        (3, False, {"doStep": [(False, False, True, 0.125)]}, "fmi3DoStep: returned early at 0.125 s"),
        (3, False, {"doStep": [(True, False, False, 0.5)]}, ""),
        (2, False, {"doStep": [DISCARDED]}, "fmi2DoStep: discarded it"),
        (2, False, {"doStep": [DISCARDED], "getBooleanStatus": [False]}, "fmi2DoStep: discarded it"),
        (
            2,
            False,
            {"doStep": [DISCARDED], "getBooleanStatus": [True], "getRealStatus": [0.25]},
            "fmi2DoStep: asks to end the simulation at 0.25 s",
        ),
        (2, False, {"doStep": [DISCARDED], "getBooleanStatus": [ValueError()]}, "fmi2DoStep: discarded it"),
        (
            2,
            False,
            {"doStep": [FMICallException("fmi2DoStep", 3)], "getBooleanStatus": [True], "getRealStatus": [0.25]},
            "fmi2DoStep: error",
        ),
        (2, False, {"setReal": [FMICallException("fmi2SetReal", 4)]}, "fmi2SetReal: fatal error"),
        (2, False, {"setReal": [FMICallException("fmi2SetReal", 5)]}, "fmi2SetReal: status 5"),
        (2, False, {"setReal": [OSError("it is gone")]}, "OSError: it is gone"),
        (2, True, {"newDiscreteStates": [NOTHING, (False, True, *NOTHING[2:])]}, "asks to end the simulation"),
        (3, True, {"completedIntegratorStep": [(False, True)]}, "asks to end the simulation"),
        (2, True, {"newDiscreteStates": [NOTHING, *[(True, *NOTHING[1:])] * 999]}, ""),
        (
            3,
            True,
            {"updateDiscreteStates": [NOTHING, *[(True, *NOTHING[1:])] * 1000]},
            "an event does not settle in 1000 iterations",
        ),
    ],
)
def test_a_refusal_is_reported_and_the_next_begin_makes_another_instance(played, version, exchange, answers, text):
    kind = "Float64" if version == 3 else "Real"
    one, fmu = played(version, exchange, tolerance="", inputs=((kind, 1, 0, 1),), **answers)
    one.begin()
    if not text:
        assert one.advance(0.0, 0.5, (1.0,)) == ()
        return
    for line in (b"first", b"second", b"", b"third"):  # only the last two lines are kept
        fmu.logger(None, 0, line)
    with pytest.raises(Refusal) as refused:
        one.advance(0.0, 0.5, (1.0,))
    assert str(refused.value) == f"{text}; it says: third"
    fmu.calls.clear()
    one.begin()  # the state of the old instance is unknown, so it is not used again
    assert fmu.calls[0].startswith("instantiate")


def test_an_fmu_is_asked_for_its_last_time_and_whether_it_has_ended(played):
    one, fmu = played(2, doStep=[DISCARDED], getBooleanStatus=[True], getRealStatus=[0.5])
    one.begin()
    with pytest.raises(Refusal, match=r"at 0\.5 s$"):
        one.advance(0.0, 1.0, ())
    # Arguments: fmi2Terminated and fmi2LastSuccessfulTime.
    assert fmu.calls[-2:] == ["getBooleanStatus(3)", "getRealStatus(2)"]


@pytest.mark.parametrize(
    ("kind", "x", "result"),
    [
        ("Boolean", 0.0, False),
        ("Boolean", -0.5, True),
        ("Real", 0.5, 0.5),
        ("Float32", 0.5, 0.5),
        ("Integer", 3.0, 3),
        ("UInt8", 2.0, 2),
        ("Integer", 2.5, "an input is a whole number, got 2.5"),
    ],
)
def test_numbers_become_the_type_of_their_variable(played, kind, x, result):
    one, fmu = played(2, inputs=((kind, 1, 0, 1),))
    one.begin()
    if isinstance(result, str):
        with pytest.raises(Refusal, match=f"^{result}$"):
            one.advance(0.0, 1.0, (x,))
        return
    one.advance(0.0, 1.0, (x,))
    assert f"set{kind}([1], [{word(result)}])" in fmu.calls


@pytest.mark.parametrize("version", [2, 3])
def test_a_state_is_freed_even_if_it_cannot_be_saved_or_restored(played, version):
    serialize = "serializeFMUState" if version == 3 else "serializeFMUstate"
    one, fmu = played(version, **{serialize: [OSError("full")]}, setFMUState=[OSError("old")])
    for call, text, freed in ((one.keep, "full", "'state'"), (lambda: one.restore(b"bytes"), "old", "'restored'")):
        one.begin()
        with pytest.raises(Refusal, match=text):
            call()
        assert fmu.calls[-1] == f"freeFMUState({freed})"
