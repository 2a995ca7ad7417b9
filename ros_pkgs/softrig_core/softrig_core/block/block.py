"""Blocks: pure numerics with named ports, usable from a Python prompt and the same in every runner."""

from __future__ import annotations

import sys
import zlib
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from functools import cached_property
from operator import attrgetter
from types import FrameType
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Generic,
    NoReturn,
    Protocol,
    Self,
    TypeGuard,
    final,
    get_args,
)

from typing_extensions import TypeVar

from ..errors import FAILURES, RunError, ScenarioError
from ..kit.draws import Draws
from ..runners import run_node
from .params import BlockParams, ParameterError, build, differing
from .port import Port, Sample

if TYPE_CHECKING:
    import numpy as np

    from .scene import Marker

Values = Mapping[str, "Sequence[float] | Sample | None"]
P = TypeVar("P", bound=BlockParams, default=Any)


# methods that make or remake a block's constants
_OPEN = frozenset({"__init__", "setup", "change", "reset"})
# attributes that the code running the block sets
_RUNNERS = frozenset({"ages", "unanswered", "realtime", "_seed", "_Block__first"})


def _check_writer(block: Block, name: str, writer: FrameType) -> None:
    """Refuse a method of a block that writes an attribute of the block in a tick.

    The code that runs the block writes from outside. The outermost method of the block on the stack decides, so `setup`
    may call other methods. Walking the stack takes microseconds. This does not slow down a tick, because every write in
    a tick is refused anyway.

    Raises
    ------
    RunError
        With file, line, method and attribute.
    """
    method, frame = "", writer
    while frame is not None:
        code = frame.f_code
        if ("self" in code.co_varnames or "self" in code.co_freevars) and frame.f_locals.get("self") is block:
            method = code.co_name
        frame = frame.f_back  # type: ignore[assignment]
    # A writer outside of all methods of the block is the code that runs it, or a test.
    if method and method not in _OPEN:
        raise RunError(
            f"{block.name or type(block).__name__}: `{method}` writes self.{name} ({writer.f_code.co_filename}, line "
            f"{writer.f_lineno}); make it a field of x and return the new x"
        )


class Level(IntEnum):
    """Severity, the numbers of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


Reports = dict[str, tuple[Level, str, int]]  # level, newest text and number of reports of each key


def note(reports: Reports, level: Level | None, key: str, text: str) -> None:
    """Store a report; one without a level withdraws the report of its key."""
    if level is None:
        reports.pop(key, None)
    else:
        reports[key] = level, text, reports[key][2] + 1 if key in reports else 1


class Block(Generic[P]):
    """A controller, reference, observer, delay or other block with `update`.

    The state of a block is one value, x: an immutable named tuple with the names of the paper. `first` creates it; the
    other methods receive it and return it. The code that runs the block stores x (`softrig_core.block.held`). The block
    itself has constants only: outside of `setup`, `change` and `reset` its methods must not write an attribute, which
    raises a RunError with file and line. Everything that follows from x is computed from x.

    ``class Lag(Block[LagParams])`` has parameters of that type, as `Params` and as the type of ``self.p``. A base class
    of several blocks leaves the type open, ``class Law(Block[P])``; used by itself, it has the default or the bound of
    `P`.

    Parameters
    ----------
    params : BlockParams, optional
        Validated parameters; default: the published values.
    name : str
        Name of the node; together with the seed it fixes the random numbers.
    **values
        Single parameters by name, in place of `params`.

    Raises
    ------
    softrig_core.block.params.ParameterError
        A parameter is unknown or out of bounds, or the block cannot be set up with the parameters; the message names
        those that differ from the published values.
    """

    Params: ClassVar[type[BlockParams]] = BlockParams
    INPUTS: ClassVar[tuple[Port, ...]] = ()
    OUTPUTS: ClassVar[tuple[Port, ...]] = ()
    AGREED: ClassVar[Mapping[str, str]] = {}  # for `agreed`: quantity to the parameter that is its value
    STATE: ClassVar[type[Any]] = tuple  # type of x; its defaults are the state before the first tick
    realtime = False  # set by the code that runs the block: the wall clock drives it, so nothing may wait in `update`
    DRAWN_BY: ClassVar[str] = ""  # module:class of a `softrig_core.drawing.Drawing`; empty: its `scene` is drawn
    TRIPS: ClassVar[frozenset[str]] = frozenset({"trip"})  # keys of reports of a protection that stays tripped
    # attributes that a tick may change in place because no answer depends on them: caches, buffers, handles
    SCRATCH: ClassVar[frozenset[str]] = frozenset()
    _seed = 0
    _open = True  # any attribute may be written until `__init__` has ended
    STALE_PERIODS: ClassVar[int] = 5  # realtime: age in its own periods at which a plant no longer trusts a command

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        # A method without x is refused where it is written, before the block's first tick fails.
        for name in ("outputs", "advance", "update", "finish", "refused"):
            code = getattr(cls.__dict__.get(name), "__code__", None)
            if code is not None and code.co_varnames[1:2] == ("t",):
                raise TypeError(
                    f"{cls.__qualname__}.{name}(self, t, ...): expected {name}(self, x, t, ...), where x is the "
                    "block's state, made by `first`"
                )
        for base in cls.__dict__.get("__orig_bases__", ()):
            for argument in get_args(base):
                types = (argument, getattr(argument, "__default__", None), getattr(argument, "__bound__", None))
                cls.Params = next((p for p in types if isinstance(p, type) and issubclass(p, BlockParams)), cls.Params)

    def __setattr__(self, name: str, value: Any) -> None:
        if not self._open and name not in _RUNNERS:
            _check_writer(self, name, sys._getframe(1))
        object.__setattr__(self, name, value)

    def __delattr__(self, name: str) -> None:
        if not self._open:
            _check_writer(self, name, sys._getframe(1))
        object.__delattr__(self, name)

    def __init__(self, params: P | None = None, name: str = "", **values: Any) -> None:
        self.p: P = build(self.Params, values) if params is None else params  # type: ignore[assignment]
        self.name = name
        self.ages: Callable[[str], int | None] | None = None  # set by the code that runs the block
        self.unanswered = 0  # own ticks that were skipped since the newest answer; 0 in lockstep
        # Reports that the code running the block has not stored yet.
        self.events: list[tuple[Level | None, str, str, bool]] = []
        try:
            self.setup()
            # `first` may draw random numbers, so the seed is set before it is called.
            self.reset(self._seed)
            # The first state is computed here, so that an error in it names the parameters; `pop_first` hands it out.
            self.__first: tuple[Any, list[Any]] | None = self.first(), self.events[:]
            # `pop_first` hands these reports to the code that runs the block.
            self.events.clear()
            self._open = False
        except (ParameterError, ScenarioError, RunError):
            raise
        # Values may each be within their bounds and fail together: an overflow, a singular matrix.
        except FAILURES as error:
            # Blocks raise a ValueError with a text for people; the text of other errors needs the type.
            kind = "" if type(error) is ValueError else f"{type(error).__name__}: "
            raise ParameterError(f"set-up failed{differing(self.p)}: {kind}{error}") from error

    @classmethod
    def seeded(cls, params: P, name: str, seed: int) -> Self:
        """Create a block with a seed, as by ``reset`` after it is made."""
        block = cls.__new__(cls)
        # `__init__` computes the first state, which may draw random numbers, so it needs the seed beforehand.
        block.__dict__["_seed"] = seed
        block.__init__(params, name)  # type: ignore[misc]
        return block

    @classmethod
    def main(cls, args: Sequence[str] | None = None) -> NoReturn:
        """Run the block as a node until its process ends; entry points of executables name ``module:Class.main``.

        Parameters
        ----------
        args : sequence of str, optional
            Command line, the name of the executable first; that of the process when absent.
        """
        run_node(cls, args)

    @classmethod
    def ports(cls, params: Any) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Return (inputs, outputs) for these parameters; override when channels depend on them. Must stay cheap."""
        return cls.INPUTS, cls.OUTPUTS

    @classmethod
    def agreed(cls, params: Any) -> Mapping[str, Any]:
        """Return values that all nodes of a rig that name them must share: quantity (``tank/k_high``) to value.

        By default these are the parameters that `AGREED` names.

        This applies to a plant, to the nodes that judge it (figures, monitors, certificates, proofs), and to what they
        assume about a controller. The assumptions of a controller about its plant are its own: they may differ from the
        plant, as an experiment.
        """
        return {quantity: attrgetter(name)(params) for quantity, name in cls.AGREED.items()}

    def setup(self) -> None:
        """Compute what depends on the parameters only; called once. Import heavy libraries here."""

    def first(self) -> Any:
        """Return the state before the first tick: `STATE` with its defaults; a block without memory has no state.

        A block whose first state depends on its parameters overrides this method. Unusual parameters are reported here
        and in `go_on`; the holder of the block receives the report.
        """
        return self.STATE()

    def pop_first(self) -> Any:
        """Return the state before the first tick, as `first` does, for the code that holds the block from now on."""
        result, self.__first = self.__first, None
        if result is None:
            self.events.clear()
            return self.first()
        self.events[:] = result[1]
        return result[0]

    def go_on(self, x: Any, before: P) -> Any:
        """Return the state with which the block continues after live parameters have changed, between two ticks.

        `p` and the constants from `setup` are the new ones. By default the state is unchanged. A block whose state
        depends on the parameters overrides this method and describes in its docstring what happens to the state. If
        practice in the field expects it, the output must not jump.

        Parameters
        ----------
        x : named tuple
        before : BlockParams
            The previous parameters; only those declared ``live=True`` differ.
        """
        return x

    def save(self, x: Any) -> Any:
        """Return a value from which `load` can restore x any number of times; it is x itself unless part of x is
        opaque.

        If something cannot be an immutable value (a solver, an FMU, a policy), x contains it as an object, and its
        block defines here how that object is stored.
        """
        return x

    def load(self, saved: Any) -> Any:
        """Return the x that was passed to `save`."""
        return saved

    @final
    def change(self, params: P) -> None:
        """Set other parameters between two ticks: `setup` is called again; `go_on` decides about the state.

        The values were checked on a spare block.

        Parameters
        ----------
        params : BlockParams
            The new ones; `p` still has the previous ones.
        """
        # A first state that was computed with the former parameters is no longer valid.
        self.p, self.__first = params, None
        self.setup()

    def warm_up(self) -> None:
        """Call native code that no first tick calls, before a node begins, on a block that is not used otherwise."""

    def reset(self, seed: int) -> None:
        """Set a seed and clear all reports; the owner of the block then calls `first`."""
        self._seed, self.__first = seed, None
        # The cached draws belong to the former seed.
        for name in ("standard_normal", "uniform"):
            self.__dict__.pop(name, None)
        self.events.clear()

    def generator(self) -> np.random.Generator:
        """Return a generator at the beginning of this block's random numbers, a function of (rig seed, block name)."""
        import numpy as np

        return np.random.default_rng(self._seeds)

    @property
    def _seeds(self) -> tuple[int, int]:
        # Python's own `hash` of a text differs from process to process, so the name enters by a checksum.
        return self._seed, zlib.crc32(self.name.encode())

    @cached_property
    def standard_normal(self) -> Draws:
        """Normal numbers by index, ``self.standard_normal(k)``: those that `generator` draws, in their order."""
        return Draws(self._seeds, "standard_normal")

    @cached_property
    def uniform(self) -> Draws:
        """Uniform numbers in [0, 1) by index, ``self.uniform(k)``: those that `generator` draws, in their order."""
        return Draws(self._seeds, "random")

    def report(self, level: Level, key: str, text: str, *, anew: bool = False) -> None:
        """Report an event of this tick, for /diagnostics; reports of a discarded tick are discarded."""
        self.events.append((level, key, text, anew))

    def withdraw(self, key: str) -> None:
        """Withdraw a report by its key, if there is one: it leaves /diagnostics."""
        self.events.append((None, key, "", False))

    @property
    def reports(self) -> Reports:
        """Return the reports by key of a block without a holder; of a running block see `RunningBlock.reports`."""
        result: Reports = {}
        for level, key, text, _ in self.events:
            note(result, level, key, text)
        return result

    def age(self, name: str) -> int | None:
        """Return the age of an input in ns at the current tick: how long ago its newest message was stamped.

        None before the first message. Outside of a run every input is new.
        """
        return 0 if self.ages is None else self.ages(name)

    @classmethod
    def ticks_at_end(cls) -> bool:
        """Return whether the block has a tick at the end time of a run: plants, observers, and blocks with `finish`."""
        return finishes(cls) or issubclass(cls, Plant | Observer)

    def health(self, *x: Any) -> Mapping[str, str]:
        """Return further entries for /diagnostics, name to text; called about once a second with the state x."""
        return {}

    def latched(self) -> Mapping[str, str]:
        """Return topic to text (such as ``robot_description``) that a node publishes once, also for late joiners."""
        return {}

    def markers(self, *x: Any) -> Sequence[Marker]:
        """Return markers to display, drawn from x; a node asks a few times a second."""
        return ()

    def update(self, *x_t: Any, **inputs: Any) -> Any:
        """Answer one tick, ``update(x, t, *, input, ...) -> (x, values)``.

        Parameters
        ----------
        x : named tuple
            What it remembers.
        t : int
            Time in ns, a multiple of the period.
        **inputs
            One keyword an input port: a tuple of floats; a `Sample` on a delayed port; None on a held
            port that has no value yet.

        Returns
        -------
        x : named tuple
            What it remembers from now on.
        values : mapping of output port name to values
            A `Sample` on a delayed port; None or nothing for silence on a sporadic one.
        """
        raise NotImplementedError

    def refused(self, *x_t: Any) -> Any:
        """Answer a tick at which the node rejected an input (NaN, wrong names); called instead of `update`.

        ``refused(x, t) -> (x, values)``

        Returns
        -------
        x : named tuple
        values : mapping or None
            As `update`; None, the default: the last outputs are held, at first the ports' safe values, and sporadic
            ports are silent.
        """
        return x_t[0], None


class Finishing(Protocol):
    """A block whose last tick has an answer of its own, such as a result over the whole record."""

    def finish(self, *x_t: Any, **inputs: Any) -> Any:
        """Return the state and outputs of the run's last tick, in place of `update`.

        The inputs are the last outputs of the plants, and the commands of the previous tick.
        """


def finishes(block: type[Block]) -> TypeGuard[type[Finishing]]:
    """Return whether a block is `Finishing`; a protocol check at each start of a run would be slow."""
    return hasattr(block, "finish")


class Plant(Block[P]):
    """A block with state that owns time: `outputs` at t_k, then `advance` to t_{k+1}.

    The outputs at t_k never depend on the inputs of t_k.
    """

    AWAITS_COMMAND: ClassVar[bool] = False  # realtime, by hand: t = 0 with the first command; it cannot do without one

    def outputs(self, *x_t: Any) -> Any:
        """Return the outputs at t (ns), ``outputs(x, t) -> values``."""
        raise NotImplementedError

    def advance(self, *x_t: Any, **inputs: Any) -> Any:
        """Return the state at t + period with the inputs held, ``advance(x, t, *, input, ...) -> x``."""
        raise NotImplementedError


class Observer(Block[P]):
    """A block that only observes; `status` returns its figures, which the node publishes as a DiagnosticArray.

    An observer also sees the last plant outputs, at the end time of a run.
    """

    def status(self, *x: Any) -> Mapping[str, tuple[float, str]]:
        """Return the figures so far, name to (value, unit), from the state x."""
        raise NotImplementedError
