"""Closed loops over real ROS topics with repeatable results: blocks, scenarios, and how they run.

What a user of the suite needs is named here, ``from softrig_core import Plant, Port, param``; a name is loaded from its
module at its first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from .bits import pin
from .interrupt import quiet_imports
from .needs import check, is_executable, join_prefix

if is_executable():  # other processes that import the package keep their settings
    quiet_imports()
    pin()  # before numpy is loaded
    join_prefix()
check()

if TYPE_CHECKING:
    from .analysis.environment import RigEnv as RigEnv
    from .analysis.environments import RigVectorEnv as RigVectorEnv
    from .analysis.linear import Sampled as Sampled, equilibrium as equilibrium, linearise as linearise
    from .analysis.linear_view import (
        LinearAlong as LinearAlong,
        LinearView as LinearView,
        linear_along as linear_along,
        linear_view as linear_view,
    )
    from .analysis.steady import (
        NoOperatingPoint as NoOperatingPoint,
        OperatingPoint as OperatingPoint,
        steady as steady,
    )
    from .arrays import Array as Array, Complex as Complex
    from .block.block import Block as Block, Level as Level, Observer as Observer, Plant as Plant, Values as Values
    from .block.held import ByHand as ByHand, RunningBlock as RunningBlock
    from .block.params import (
        BlockParams as BlockParams,
        ParameterError as ParameterError,
        Params as Params,
        check_steps as check_steps,
        param as param,
    )
    from .block.port import (
        Port as Port,
        Refused as Refused,
        Sample as Sample,
        array as array,
        button as button,
        command as command,
        joint_state as joint_state,
        number as number,
        pose as pose,
        reference as reference,
        scalars as scalars,
        vector3 as vector3,
        wrench as wrench,
    )
    from .block.scene import Marker as Marker, Pose as Pose, Scene as Scene
    from .errors import RunError as RunError, ScenarioError as ScenarioError
    from .former import Held as Held, executable as executable, run_processes as run_processes
    from .judge.measures import SignalMap as SignalMap, figure as figure, window as window
    from .kit.compiled import Compiled as Compiled
    from .kit.history import History as History
    from .kit.jit import jit as jit
    from .kit.ode import RESOLVED as RESOLVED, resolving_step as resolving_step, rk4 as rk4, rk4_loop as rk4_loop
    from .kit.resource import resource as resource
    from .kit.state import state_type as state_type
    from .rig.rig import Rig as Rig
    from .run.expand import rig_of as rig_of
    from .run.inprocess import run_inprocess as run_inprocess
    from .run.replay import feed as feed
    from .run.session import Session as Session
    from .run.simulate import Run as Run, simulate as simulate
    from .scenario.scenario import Scenario as Scenario, load_scenario as load_scenario
    from .scenario.scenario_file import list_scenarios as list_scenarios
    from .solver.solver import Jobs as Jobs, Result as Result, Solver as Solver, SolverParams as SolverParams
    from .solver.worker import Work as Work
    from .timebase import SECOND as SECOND, to_ns as to_ns, to_s as to_s
    from .verdict.figures import Figure as Figure, evaluate as evaluate, figures_of as figures_of
    from .verdict.watch import Watch as Watch, WatchParams as WatchParams
    from .wire.recording import Recording as Recording
    from .wire.signals import Signals as Signals
else:
    _HOMES = {
        "arrays": "Array Complex",
        "errors": "RunError ScenarioError",
        "block.block": "Block Level Observer Plant Values",
        "block.held": "ByHand RunningBlock",
        "kit.compiled": "Compiled",
        "kit.history": "History",
        "kit.jit": "jit",
        "analysis.linear": "Sampled equilibrium linearise",
        "kit.ode": "RESOLVED resolving_step rk4 rk4_loop",
        "block.params": "BlockParams ParameterError Params check_steps param",
        "block.port": "Port Refused Sample array button command joint_state number pose reference scalars vector3 "
        "wrench",
        "kit.resource": "resource",
        "block.scene": "Marker Pose Scene",
        "solver.solver": "Jobs Result Solver SolverParams",
        "kit.state": "state_type",
        "timebase": "SECOND to_ns to_s",
        "solver.worker": "Work",
        "former": "Held executable run_processes",
        "analysis.environment": "RigEnv",
        "analysis.environments": "RigVectorEnv",
        "verdict.figures": "Figure evaluate figures_of",
        "run.expand": "rig_of",
        "run.inprocess": "run_inprocess",
        "analysis.linear_view": "LinearAlong LinearView linear_along linear_view",
        "judge.measures": "SignalMap figure window",
        "run.replay": "feed",
        "rig.rig": "Rig",
        "scenario.scenario": "Scenario load_scenario",
        "scenario.scenario_file": "list_scenarios",
        "run.session": "Session",
        "run.simulate": "Run simulate",
        "analysis.steady": "NoOperatingPoint OperatingPoint steady",
        "verdict.watch": "Watch WatchParams",
        "wire.recording": "Recording",
        "wire.signals": "Signals",
    }
    _HOME = {name: f"{__name__}.{home}" for home, names in _HOMES.items() for name in names.split()}

    def __getattr__(name):
        if name not in _HOME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = globals()[name] = getattr(import_module(_HOME[name]), name)
        return value

    def __dir__():
        return sorted({*globals(), *_HOME})
