"""Closed loops over real ROS topics that come out the same every time: blocks, scenarios, and how they run.

What a user of the suite needs is named here, ``from softrig_core import Plant, Port, param``; each name comes from its
module when it is first asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from .bits import pin
from .interrupt import quiet_imports
from .needs import check, join_prefix

quiet_imports()
pin()  # before numpy is loaded
check()
join_prefix()

if TYPE_CHECKING:
    from .errors import RunError as RunError, ScenarioError as ScenarioError
    from .model.block import Block as Block, Level as Level, Observer as Observer, Plant as Plant, Values as Values
    from .model.compiled import Compiled as Compiled
    from .model.history import History as History
    from .model.jit import jit as jit
    from .model.linear import Sampled as Sampled, equilibrium as equilibrium, linearise as linearise
    from .model.marker import Marker as Marker
    from .model.ode import rk4 as rk4, rk4_loop as rk4_loop
    from .model.params import (
        BlockParams as BlockParams,
        ParameterError as ParameterError,
        Params as Params,
        check_steps as check_steps,
        param as param,
    )
    from .model.port import (
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
    from .model.resource import resource as resource
    from .model.scene import Pose as Pose, Scene as Scene
    from .model.solver import Result as Result, Solver as Solver, SolverParams as SolverParams
    from .model.state import state_type as state_type
    from .model.worker import Work as Work
    from .node import executable as executable
    from .rig.environment import RigEnv as RigEnv
    from .rig.figures import Figure as Figure, evaluate as evaluate, figures_of as figures_of
    from .rig.inprocess import run_inprocess as run_inprocess
    from .rig.linear_view import LinearView as LinearView, linear_view as linear_view
    from .rig.measures import SignalMap as SignalMap, figure as figure, window as window
    from .rig.processes import run_processes as run_processes
    from .rig.replay import feed as feed
    from .rig.rig import Rig as Rig
    from .rig.scenario import Scenario as Scenario, load_scenario as load_scenario
    from .rig.scenario_file import list_scenarios as list_scenarios
    from .rig.simulate import Run as Run, rig_of as rig_of, simulate as simulate
    from .rig.steady import NoOperatingPoint as NoOperatingPoint, OperatingPoint as OperatingPoint, steady as steady
    from .rig.watch import Watch as Watch, WatchParams as WatchParams
    from .timebase import SECOND as SECOND, to_ns as to_ns, to_s as to_s
    from .wire.recording import Recording as Recording
    from .wire.signals import Signals as Signals
else:
    _HOMES = {
        "errors": "RunError ScenarioError",
        "model.block": "Block Level Observer Plant Values",
        "model.compiled": "Compiled",
        "model.history": "History",
        "model.jit": "jit",
        "model.linear": "Sampled equilibrium linearise",
        "model.marker": "Marker",
        "model.ode": "rk4 rk4_loop",
        "model.params": "BlockParams ParameterError Params check_steps param",
        "model.port": "Port Refused Sample array button command joint_state number pose reference scalars vector3 "
        "wrench",
        "model.resource": "resource",
        "model.scene": "Pose Scene",
        "model.solver": "Result Solver SolverParams",
        "model.state": "state_type",
        "timebase": "SECOND to_ns to_s",
        "model.worker": "Work",
        "node": "executable",
        "rig.environment": "RigEnv",
        "rig.figures": "Figure evaluate figures_of",
        "rig.inprocess": "run_inprocess",
        "rig.linear_view": "LinearView linear_view",
        "rig.measures": "SignalMap figure window",
        "rig.processes": "run_processes",
        "rig.replay": "feed",
        "rig.rig": "Rig",
        "rig.scenario": "Scenario load_scenario",
        "rig.scenario_file": "list_scenarios",
        "rig.simulate": "Run rig_of simulate",
        "rig.steady": "NoOperatingPoint OperatingPoint steady",
        "rig.watch": "Watch WatchParams",
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
