"""Observers as windows with figures: each message counts once, and only matching ones are paired."""

from concurrent.futures import ThreadPoolExecutor
from threading import Event
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import in_process, make_scenario
from faultrig import COMMAND, REFERENCE, STATE, Gain, Lag, Source
from softrig_core import ByHand, Figure, Recording, Rig, Signals, Watch, WatchParams, rig_of, run_inprocess
from softrig_core.judge import measures
from softrig_core.run import live_figures

X, U, R = "lag/state/x/position", "lag/command/u/effort", "lag/reference/x/position"


class Eye(Watch[WatchParams]):
    INPUTS = (STATE, COMMAND, REFERENCE)

    def figures(self, x):
        yield self.figure("rms_error", measures.rms, {"signal": X, "reference": R})
        yield self.figure("mean_command", measures.mean, {"signal": U})
        yield self.figure("variation", measures.total_variation, {"signal": U})
        yield self.figure("last", measures.final_value, {"signal": X})
        yield self.figure("never", measures.rise_time, {"signal": X, "final": 1e9})


@pytest.mark.parametrize("period", [0.01, 0.05])
def test_running_figures_equal_those_of_the_recording_to_the_last_bit(period):
    """A command with five times the period is not counted five times, and the last output is not paired with old
    inputs.
    """
    rig = Rig.from_blocks(
        {"plant": Lag(), "source": Source(), "gain": Gain(period=period, noise=0.1), "eye": Eye()}, 1.0
    )
    status = run_inprocess(rig, 3)["eye"].status()
    signals = Signals(in_process(rig, 3))
    assert status == {
        "rms_error": (measures.rms(signals, X, reference=R), "m"),
        "mean_command": (measures.mean(signals, U), "N"),
        "variation": (measures.total_variation(signals, U), "N/s"),
        "last": (signals[X].x[-1], "m"),
    }


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_running_figures_are_published_while_there_is_a_subscriber(mode):
    """In real time they are measured beside the ticks, from the messages at the time of the request."""
    import diagnostic_msgs.msg  # noqa: F401
    from softrig_nodes.face.faces import Faces

    rig = Rig.from_blocks({"plant": Lag(), "source": Source(), "gain": Gain(), "eye": Eye()}, 1.0)
    eye, messages, readers, pause = run_inprocess(rig, 3)["eye"], [], [0], Event()
    expected = {name: f"{value:.9g} {unit}" for name, (value, unit) in eye.status().items()}

    class Publisher:
        publish = messages.append

        def get_subscription_count(self):
            return readers[0]

    class Nobody(Publisher):
        def get_subscription_count(self):
            return 0

    faces = object.__new__(Faces)
    faces._adapter = SimpleNamespace(step=eye, block=eye.block, t=eye.t, middleware=SimpleNamespace(name="eye"))
    faces._figures, faces._diagnostics, faces._markers = Publisher(), Nobody(), None
    faces._measured, faces._checks = None, 0
    faces._executor = ThreadPoolExecutor(1) if mode == "realtime" else None
    faces._publish_diagnostics()
    assert not messages
    assert faces._measured is None
    readers[0] = 1
    if faces._executor:
        faces._executor.submit(pause.wait)
    faces._publish_diagnostics()
    if faces._executor:
        eye.x = eye.block.first()  # meanwhile the block continues
        faces._publish_diagnostics()  # at most one computation is in progress
        faces._check()
        assert not messages
        pause.set()
        faces._measured.result()
        faces._check()
        assert faces._measured is None
    ((status,),) = [message.status for message in messages]
    assert {v.key: v.value for v in status.values} == expected
    assert "mean_command" in expected


def test_the_window_moves_and_drops_old_messages():
    rig = Rig.from_blocks({"plant": Lag(), "source": Source(), "gain": Gain(), "eye": Eye(window=0.25)}, 1.0)
    status = run_inprocess(rig, 0)["eye"].status()
    signals = Signals(in_process(rig))
    assert status["mean_command"][0] == measures.mean(signals, U, start=0.75)
    assert status["mean_command"][0] != measures.mean(signals, U)


def test_without_messages_there_are_no_figures_and_reset_drops_them():
    eye = ByHand(Eye())
    assert eye.status() == {}
    eye.update(0, state=(1.0, 0.0), command=(2.0,), reference=(3.0,))
    assert eye.status()["last"] == (1.0, "m")
    eye.reset(0)
    assert eye.status() == {}


def test_an_offline_reference_is_not_paired_with_the_output_at_the_end():
    signals = Signals(in_process(rig_of(make_scenario({"plant": "plant", "source": "source", "gain": "gain"}))))
    t, x = signals[X]
    when, r = signals[R]
    assert t.size == when.size + 1
    assert measures.peak(signals, X, reference=R) == abs(x[:-1] - r).max()


def test_a_figure_counts_from_the_newest_step_of_its_reference():
    """Steps to 1 at 0 s, to 3 at 2 s; the signal follows a sample of 0.5 s later, and says 9 at 4 s."""
    t = np.arange(0.0, 4.5, 0.5)
    signals = {
        "r": (np.array([0.0, 1.0, 2.0, 3.0]), np.array([1.0, 1.0, 3.0, 3.0])),
        "y": (t, np.where(t == 4.0, 9.0, np.where(t > 2.0, 3.0, np.where(t > 0.0, 1.0, 0.0)))),
    }

    def measured(function, **arguments):
        return Figure("it", function, {"signal": "y", **arguments}, "", 1.0, "r")(signals)

    # The peak is 6 beyond the final value of the step from 1 to 3.
    assert measured(measures.overshoot) == pytest.approx(300.0)
    assert measured(measures.overshoot, end=1.5) == 0.0
    # With a final value given, the step starts at 0.
    assert measured(measures.overshoot, final=6.0) == pytest.approx(50.0)
    assert measured(measures.minimum) == 1.0
    assert measured(measures.minimum, start=0.5) == 3.0
    assert measured(measures.mean_error, reference="r", start=0.5, end=1.5) == 0.0
    assert measured(measures.mean_error, reference="r", end=0.0) == 2.0
    with pytest.raises(ValueError, match="r has 0 samples"):
        Figure("it", measures.mean, {"signal": "y"}, "", 1.0, "r")({**signals, "r": (np.array([]), np.array([]))})


@pytest.mark.parametrize("window", [60.0, 0.015])
def test_a_recording_has_the_figures_of_a_node_that_stored_the_messages(window):
    """Also with windows shorter than the run: messages outside the window count for neither."""
    rig = rig_of("induction_dtc_short", duration=0.05, overrides={"flux_monitor.window": window})
    recording = Recording((topic, port.msgtype) for topic, port in rig.topics.items())
    kept = run_inprocess(rig, 1, recording)["flux_monitor"].status()
    node = next(m for m in rig.members if m.name == "flux_monitor")
    assert live_figures.is_recorded(node)
    assert dict(live_figures.Measured(node, 1, lambda: Signals(recording)).status()) == dict(kept)
    assert len(kept) >= 3
    assert "flux_monitor" not in run_inprocess(rig, 1, without={"flux_monitor"})
    rare = rig_of("induction_dtc_short", overrides={"flux_monitor.period": 0.001})
    assert not live_figures.is_recorded(next(m for m in rare.members if m.name == "flux_monitor"))
