"""Tables of the page *Names*: the terms of drives and ROS engineers, and their names in softrig."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache

from softrig_bringup import cli
from softrig_core import Port, ScenarioError
from softrig_core.block.block import Block
from softrig_core.block.params import declarations
from softrig_core.renamed import executables, former
from softrig_core.rig.installed import load_block

PACKAGES = ("control", "drives", "power", "robots", "systems", "optim", "core", "bags")

# The usual term of each node; a test checks that every executable is listed.
NODES: Mapping[str, str] = {
    "control/c_controller": "C function, S-function in C, MEX",
    "control/c_plant": "C function, S-function in C, MEX",
    "control/command_source": "From Workspace, stimulus, signal generator",
    "control/fault": "fault injection, failure insertion unit (FIU)",
    "control/fieldbus_delay": "transport delay, network delay",
    "control/fmu_controller": "FMU, co-simulation slave",
    "control/fmu_plant": "FMU, co-simulation slave",
    "control/forward_command": "ros2_controllers forward_command_controller",
    "control/gpc_certificate": "terminal cost and set of an MPC",
    "control/gpc_controller": "generalised predictive control, linear MPC",
    "control/linear_plant": "transfer function, LTI system",
    "control/pid_controller": "PID; ros2_controllers pid_controller",
    "control/policy": "RL policy, trained agent",
    "control/reference_source": "set-point generator, trajectory source",
    "control/requirement_monitor": "STL monitor, assertion, watchdog of a signal",
    "control/scalar_source": "constant or step block",
    "control/unit_delay": "1/z, one sample of computing delay",
    "drives/bldc_plant": "BLDC motor with six-switch inverter, trapezoidal EMF",
    "drives/current_controller": "phase current controller of a switched reluctance machine",
    "drives/current_sensor": "shunt or Hall current measurement with ADC",
    "drives/dc_axis_controller": "state feedback position controller of a servo axis, Smith predictor",
    "drives/dc_axis_plant": "servo axis: DC motor with spindle",
    "drives/dc_motor_pid": "PID speed controller",
    "drives/dc_motor_plant": "permanent-magnet DC motor with H-bridge",
    "drives/dc_motor_smc": "sliding mode speed controller",
    "drives/dc_motor_smc_kalman": "sliding mode controller with Kalman filter",
    "drives/dc_motor_uno": "firmware in the loop on an Arduino Uno",
    "drives/dtc_controller": "direct torque control (Takahashi), switching table",
    "drives/flux_observer": "sensorless observer: active flux, PLL",
    "drives/foc_controller": "FOC, vector control of a PMSM, with MTPA and field weakening",
    "drives/induction_dtc_plant": "induction motor (IM, ACIM) behind switching states, with current ADC",
    "drives/induction_foc_controller": "indirect rotor-field orientation, IFOC",
    "drives/induction_plant": "induction motor (IM, ACIM) with inverter",
    "drives/lsrm_fuzzy": "fuzzy speed controller",
    "drives/lsrm_load": "load mass and friction",
    "drives/lsrm_mrac": "model reference adaptive control",
    "drives/lsrm_pi": "PI speed controller",
    "drives/lsrm_plant": "linear switched reluctance machine with asymmetric half bridges",
    "drives/pmsm_plant": "PMSM, IPMSM, SynRM with inverter",
    "drives/profile_generator": "motion profile, trapezoidal velocity",
    "drives/shaft_sensor": "quadrature encoder, resolver, Hall sensors",
    "drives/six_step_controller": "six-step (block, trapezoidal) commutation",
    "drives/speed_controller": "PI speed loop in front of a torque loop",
    "drives/step_buttons": "jog buttons",
    "drives/vhz_controller": "V/f, scalar control, volts per hertz",
    "power/dcdc_plant": "buck and boost converter",
    "power/dispatch_solver": "economic dispatch, unit commitment of one hour",
    "power/fault_locator": "two-terminal fault location",
    "power/gupfc_plant": "generalised unified power flow controller, FACTS",
    "power/line_plant": "transmission line with fault, travelling waves",
    "power/location_marker": "RViz marker",
    "power/mppt_optimiser": "MPPT: perturb and observe, particle swarm",
    "power/power_flow": "load flow, Newton-Raphson",
    "power/pulse_generator": "PWM or 48-pulse gate signals",
    "power/pv_curves": "I-V and P-V curves",
    "power/pv_plant": "PV string with boost converter",
    "power/rectifier_gpc": "MPC of a PWM rectifier (active front end)",
    "power/rectifier_plant": "three-phase PWM rectifier, active front end",
    "power/series_controller": "control of the series converters of a FACTS device",
    "power/shading_source": "irradiance profile",
    "power/shunt_controller": "STATCOM control",
    "power/unit_fleet": "generators with ramp limits",
    "robots/arm_controller": "computed torque, inverse dynamics, PD with gravity, impedance control",
    "robots/arm_plant": "rigid-body arm of a URDF",
    "robots/impedance": "impedance (admittance) filter of a reference",
    "robots/manipulator_controller": "voltage control strategy (VCS) of an arm: adaptive sliding mode",
    "robots/manipulator_plant": "arm with DC motors and gears",
    "robots/patient": "interaction force, disturbance",
    "robots/rehab_controller": "voltage-based joint controller",
    "robots/rehab_plant": "exoskeleton of a leg",
    "robots/rehab_reference": "passive range of motion (PROM), joint trajectory",
    "robots/robot_dynamics": "inverse and forward dynamics, Jacobian (RNEA, CRBA, ABA)",
    "robots/trajectory_source": "joint trajectory",
    "robots/tuner": "automatic tuning",
    "systems/aqm_controller": "active queue management: PI, RED's successor, sliding mode",
    "systems/collocation_planner": "direct collocation, optimal control solver",
    "systems/delay_line": "transport delay, also one that varies",
    "systems/lyapunov_monitor": "Lyapunov function along the trajectory",
    "systems/margin_search": "delay margin",
    "systems/momentum_feedback": "state feedback, LQR",
    "systems/mvim_planner": "optimal control by variational iteration",
    "systems/ocp_evaluator": "cost functional, residual of the optimality system",
    "systems/ocp_plant": "plant of an optimal control problem",
    "systems/ocp_player": "feed-forward of a planned trajectory",
    "systems/pendulum_controller": "state feedback",
    "systems/pendulum_plant": "inverted pendulum with spring contact",
    "systems/pwa_certificate": "stability certificate, Lyapunov-Krasovskii LMI",
    "systems/scalar_plant": "first-order plant",
    "systems/spacecraft_plant": "rigid spacecraft, attitude momentum",
    "systems/switched_delay_plant": "piecewise affine (switched) system with delay",
    "systems/tank_controller": "level controller",
    "systems/tank_plant": "tank with outlet",
    "systems/tcp_fluid": "fluid model of TCP (Misra, Hollot)",
    "systems/tcp_packets": "packet simulation, discrete events",
    "systems/two_state_plant": "second-order plant",
    "optim/optimiser": "extremum seeking, optimisation on line",
    "core/clock": "/clock publisher, simulation time",
    "core/figures": "key figures while it runs: rise time, overshoot",
    "bags/tape": "ros2 bag play, as a node of a rig",
}

VERBS: Mapping[str, str] = {
    "run": "ros2 launch; Simulink sim; a test run",
    "view": "PlotJuggler, Foxglove, a scope with knobs",
    "report": "test report",
    "draw": "plot, export of figures",
    "list": "ros2 pkg executables, ros2 topic list -v",
    "study": "parameter sweep, Monte Carlo, design of experiments",
    "falsify": "search for a counterexample (Breach, S-TaLiRo)",
    "check": "pytest, acceptance test, continuous integration; `--claims`: comparison with the publication",
    "golden": "regression baseline, reference data",
    "linearise": "linearize, linmod, Bode plot, margins",
    "steady": "trim, findop, operating point",
    "node": "ros2 run",
    "set": "ros2 param set",
    "bag": "ros2 bag",
    "new": "ros2 pkg create",
    "export": "code generation (Embedded Coder), FMU export",
    "pack": "archive of an experiment",
    "setup": "rosdep install, pip install",
    "env": "source install/setup.bash",
    "python": "python3 of the environment",
    "docs": "documentation build",
    "bench": "benchmark",
}

# The usual term, softrig's name, and the reason for it.
PARAMETERS: tuple[tuple[str, str, str], ...] = (
    ("T_s, sampling time, 1/f_s", "period", "of every node, in s; also as a fraction `1/16000`"),
    (
        "R_s, phase resistance",
        "R_s R",
        "of one phase in star; `R` of a phase of BLDC motors, of the armature of DC motors",
    ),
    ("L_d, L_q; L_s", "L_d L_q", "of one phase in star; a surface machine has both equal"),
    (
        "lambda_m, psi_PM, K_e",
        "psi_f",
        "peak flux linkage of one phase, V s; `softrig new --rated K_e=...` converts",
    ),
    ("R_r', L_ls, L_m", "R_R L_sigma L_M", "of the inverse-gamma circuit: one leakage, on the stator's side"),
    ("p, n_p, poles", "pole_pairs", "half the number of poles"),
    ("K_t, K_e", "Kt Ke k_e", "`Kt`, `Ke` of DC motors as in their papers; `k_e` of BLDC: one phase, flat top"),
    (
        "I_max, current limit",
        "i_max trip_current",
        "`i_max`: the controller's limit, peak; `trip_current`: protection of the plant",
    ),
    ("V_dc, DC bus", "U_dc U", "`U_dc` of inverters, `U` the supply of a DC/DC converter"),
    ("f_sw, f_PWM", "period updates", "carrier frequency: one period of the controller, or two updates in it"),
    ("T_d, dead time", "dead_time", "s; the error is T_d f_s U_dc sign(i)"),
    ("J_m, rotor inertia", "J J_load", "`J_load` is on the other side of an elastic shaft"),
    ("b, D, viscous friction", "B b", "`B` of machines; `b` as in the papers of the DC motor"),
    ("K_p, K_i, K_d", "kp ki kd", "the parallel form; `t_i`, `t_d` for ideal and series"),
    ("K_p, K_i of a paper", "K_p K_i K_e K_de K_u", "of the linear motor's controllers: the paper's letters"),
    (
        "bandwidth, alpha_c, omega_c",
        "current_bandwidth speed_bandwidth",
        "rad/s, as in motulator and Harnefors; not Hz",
    ),
    ("set point, reference, command", "set_point", "constant in place of a reference topic; a topic wins over it"),
    (
        "initial state",
        "x0 x_0 w_0 v_0 theta_0 position",
        "`position`, `velocity` of joints; letters with 0 of equations",
    ),
    (
        "u_max, saturation",
        "u_max v_max vmax u_limit_v F_max",
        "`v_max` of robots, `vmax` of the DC motor's paper, `u_limit_v` in V of an axis in mm",
    ),
    ("N_p, N_c, lambda", "Np Nc lam", "horizons and weight of GPC"),
)

TOPICS: tuple[tuple[str, str, str], ...] = (
    (
        "/joint_states",
        "joint_states",
        "as robot_state_publisher expects; `motor/state`, `axis/state`, `pendulum/state` "
        "where a rig has sensors and truth side by side",
    ),
    (
        "set point, reference, command of the outer loop",
        "reference motor/reference axis/reference speed_ref torque_ref force_cmd dispatch/setpoints",
        "four styles, kept: recorded bags and rigs of users have them; `remap` renames one",
    ),
    (
        "gate signals, switching states",
        "gates switches duty",
        "`gates` -1, 0 to 1 a leg; `switches` 0 or 1; `duty` 0 to 1 averaged",
    ),
    (
        "i_abc, v_abc",
        "currents phase_currents grid_current",
        "three phases: Vector3Stamped, frame_id abc, alpha_beta or dq",
    ),
    ("wrench", "patient_force tool_force", "WrenchStamped"),
    ("/diagnostics", "health", "numbers of a controller that protects; texts are in /diagnostics as well"),
)


def names(kind: str) -> str:
    """Return one of the tables, by its name."""
    tables = {"nodes": _nodes, "renamed": _renamed, "verbs": _verbs, "parameters": _parameters, "topics": _topics}
    return "\n".join(tables[kind]())


@cache
def blocks() -> dict[str, type[Block]]:
    """Return the block classes of all executables by ``PACKAGE/EXECUTABLE``, without ``softrig_``."""
    result = {}
    for package in PACKAGES:
        for executable in executables(f"softrig_{package}"):
            try:
                result[f"{package}/{executable}"] = load_block(f"softrig_{package}", executable)
            except ScenarioError:  # the executable is a tool, not a node
                continue
    return result


def _nodes() -> Iterator[str]:
    for package in PACKAGES:
        rows = {n.partition("/")[2]: b for n, b in blocks().items() if n.startswith(f"{package}/")}
        yield from ("<details>", f"<summary>softrig_{package}: {len(rows)} nodes</summary>", "")
        yield from ("| node | what it is | in the field |", "|---|---|---|")
        for name, block in rows.items():
            about = (block.__doc__ or "").strip().splitlines()[0].replace("|", "\\|").replace(":math:", "")
            yield f"| `{name}` | {about} | {NODES[f'{package}/{name}']} |"
        yield from ("", "</details>", "")


def _renamed() -> Iterator[str]:
    yield from ("| old | new |", "|---|---|")
    for package in (f"softrig_{p}" for p in PACKAGES):
        yield from (f"| `{package} {old}` | `{new}` |" for old, new in former(package).items())


def _verbs() -> Iterator[str]:
    yield from ("| command | in the field |", "|---|---|")
    yield from (f"| `softrig {verb}` | {VERBS[verb]} |" for group in cli.GROUPS.values() for verb in group)


def _parameters() -> Iterator[str]:
    known = {d.name for block in blocks().values() for d in declarations(block.Params)}
    known |= {name.rpartition(".")[2] for name in known}
    yield from _chosen("parameter here", PARAMETERS, known)


def _topics() -> Iterator[str]:
    yield from _chosen("topic here", TOPICS, {port.topic for port in ports()} | {port.name for port in ports()})


def _chosen(head: str, rows: tuple[tuple[str, str, str], ...], known: set[str]) -> Iterator[str]:
    yield from (f"| in the field | {head} | |", "|---|---|---|")
    for field, here, why in rows:
        if strange := set(here.split()) - known:
            raise ValueError(f"no node has {', '.join(sorted(strange))}; correct the table in scripts/pages/names.py")
        yield f"| {field} | {', '.join(f'`{name}`' for name in here.split())} | {why} |"


@cache
def ports() -> tuple[Port, ...]:
    """Return the ports of all executables that have defaults."""
    results: list[Port] = []
    for block in blocks().values():
        try:
            inputs, outputs = block.ports(block.Params())
        except ValueError:  # the node has no ports without its file
            continue
        results += [*inputs, *outputs]
    return tuple(results)
