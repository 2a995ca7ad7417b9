"""The ``run.*`` parameters that every node has besides those of its block, and the links that a runner passes."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, field_validator

from ..block.params import Params, param
from ..block.port import Port

SLOWEST = 1e-12  # pace


class RunOptions(Params):
    """Options of a node's run; the defaults are those of a node started alone with ``ros2 run``."""

    mode: Literal["realtime", "lockstep"] = param("realtime", "against the wall clock, or tick by tick with its peers")
    seed: int = param(0, "rig seed of all random numbers", ge=0, le=2**63 - 1)
    duration: float = param(0.0, "length of the run, 0 = until stopped", "s", ge=0, le=1e9)
    timeout: float = param(
        10.0, "lockstep: wall-clock time without progress before the node gives up", "s", gt=0, le=1e6
    )
    patience: float = param(
        0.8, "realtime: part of its period that a law waits for the inputs that are due", ge=0, le=1
    )
    stamp_window: float = param(1.0, "realtime: distance from now at which a stamp is refused", "s", gt=0, le=1e6)
    start_timeout: float = param(
        30.0, "wall-clock time to wait for all peers of a rig, 0 = for ever", "s", ge=0, le=1e6
    )
    paired: tuple[str, ...] = param((), "lockstep, started alone: held inputs that are paired by stamp like the others")
    watchdog: float = param(
        0.0, "realtime: age at which a command is stale, 0 = the plant's number of periods", "s", ge=0, le=1e6
    )
    frames: bool = param(True, "publish /tf and /tf_static, where others than the rig may read them")
    shard: str = param("", "file to record published messages in")
    status: str = param("", "file for the state of the node, as JSON")
    epoch: int = param(
        0, "realtime: wall-clock time in ns that is t = 0, 0 = when all nodes of the rig are up", ge=0, le=2**63 - 1
    )
    links: str = param("", "JSON of `Links`, written by the runner", max_length=1 << 20)
    paused: bool = param(False, "the node of the clock: holds the run at t = 0 until it is resumed")
    pace: float = param(
        0.0,
        "lockstep, the node of the clock: simulated by wall-clock time, 0 = as fast as possible, else at least 1e-12",
        ge=0,
        le=1e3,
        live=True,
    )
    again: str = param("", "lockstep: folder of the files of a run in which this node died and is restarted")
    link: str = param("", "JSON of a scenario's `link`: a board answers the ticks", max_length=1 << 12)
    changes: str = param("", "JSON of changes of parameters while it runs, written by the runner", max_length=1 << 20)

    @field_validator("pace")
    @classmethod
    def _goes_on(cls, pace: float) -> float:
        if 0.0 < pace < SLOWEST:  # the arithmetic of the wait would overflow
            raise ValueError(f"expected 0 or at least {SLOWEST:g}")
        return pace


class InputLink(BaseModel):
    """An input that is paired with a sender of the rig.

    Parameters
    ----------
    period : str
        Period of the sender, s, as a fraction.
    at_end : bool
        Whether it also sends at the end time of the run, as plants do.
    port : str
        Name of the sender's port.
    sporadic : bool
        Whether that port may be silent; the sender's acknowledgements then report whether it was.
    delayed : bool
        Whether its messages are stamped with another time than that of their tick.
    reports_silence : bool
        Realtime: whether a controller also receives these acknowledgements and waits for them.
    """

    model_config = ConfigDict(extra="forbid")
    period: str
    node: str
    at_end: bool = True
    port: str = ""
    sporadic: bool = False
    delayed: bool = False
    reports_silence: bool = False


class OverheardLink(InputLink):
    """An output of an external node.

    Parameters
    ----------
    shape : dict
        Fields of the port by which its messages are read.
    """

    shape: dict[str, Any]

    @classmethod
    def of(cls, port: Port, **link: Any) -> OverheardLink:
        """Return the link for an output to which a port subscribes."""
        return cls(shape=asdict(port), **link)

    def made(self) -> Port:
        """Return the port that the link describes."""
        return Port(**{name: _tuples(value) for name, value in self.shape.items()})


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


class Links(BaseModel):
    """Description of a node's peers in its rig.

    Parameters
    ----------
    base : str
        Period of the clock in s, as a fraction; empty for a node by itself.
    inputs : by port name
        Paired inputs; a held input that is not listed accepts any message.
    records : list of str, optional
        Inputs from outside the rig that this node records, at the tick at which they take effect; absent: all.
    readers : by port name
        Nodes that must be matched before the first message.
    free : list of str
        Inputs from external nodes that may be silent. No acknowledgement reports that, so they accept any message.
    overheard : list of OverheardLink
        Topics that external nodes publish and this node records.
    guests : bool
        Whether nodes of the rig are external: the first messages are then published again for late subscribers.
    outside : list of str
        Topics of external nodes: the subscriptions of the nodes that publish them must be matched too.
    clock : InputLink, optional
        The node that publishes /clock, when this node paces itself by it.
    follows_clock : bool
        Subscribes to /clock without using it: an external plant may publish it and wait for its subscribers.
    owns_clock : bool
        Publishes /clock.
    acknowledges : bool
        Publishes each tick's stamp on ``<node>/tick``, so that the plant never runs ahead of it. The message also
        lists the sporadic ports that published at that tick.
    tick_readers : list of str
        Nodes that read these acknowledgements.
    silence_readers : list of str
        Realtime: nodes that read which sporadic ports published at each tick.
    acks : by node name
        Nodes whose ticks the owner of the clock waits for, with their period in s. An external plant waits only for
        the node that commands it. That node then waits for their ticks before its own, and a source waits for the
        ticks of its readers.
    followers : list of str
        Lockstep: nodes of the rig on which nothing depends. The clock may be some ticks ahead of them.
    clock_readers : list of str
        Nodes that pace themselves by /clock.
    solvers : list of str
        Nodes that may work for longer than the timeout of the others, and report so.
    starter : str
        Realtime: the node that sets the time of t = 0.
    starts : list of str
        All nodes of the rig that are ours: in real time it waits for them.
    grid : str
        Longest period of the rig, s; in real time t = 0 is a multiple of it.
    public : bool
        The ROS domain may be shared with others: recorders that ask for it are awaited.
    recorders : list of str
        Nodes outside the rig that read everything and are awaited.
    returns : bool
        Lockstep: a node that died is started again. Repeated messages are ignored, and no node ends by itself.
    """

    model_config = ConfigDict(extra="forbid")
    base: str = ""
    inputs: dict[str, InputLink] = {}
    records: list[str] | None = None
    readers: dict[str, list[str]] = {}
    free: list[str] = []
    overheard: list[OverheardLink] = []
    guests: bool = False
    outside: list[str] = []
    clock: InputLink | None = None
    follows_clock: bool = False
    owns_clock: bool = False
    acknowledges: bool = False
    tick_readers: list[str] = []
    silence_readers: list[str] = []
    acks: dict[str, str] = {}
    followers: list[str] = []
    clock_readers: list[str] = []
    solvers: list[str] = []
    starter: str = ""
    starts: list[str] = []
    grid: str = ""
    public: bool = False
    recorders: list[str] = []
    returns: bool = False
