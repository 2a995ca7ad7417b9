"""The outline of the site: four kinds of pages, kept apart, and the gallery of systems."""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]

# How-to guides by the purpose of the reader.
GUIDES = {
    "Set up and keep up to date": ("set_up", "wheel", "workspace", "upgrade", "distribution"),
    "Run, watch and compare": ("view", "studies", "linear_view", "reports", "ends", "two_machines"),
    "Connect what is yours": ("node", "cpp_node", "c_law", "own_robot", "learning"),
    "Go to hardware": ("hardware", "boards", "plc"),
    "Use results elsewhere": ("paper_figures", "bags", "bags_pandas", "outside_tools", "python", "notebooks"),
    "Share, teach and keep correct": ("send", "strangers", "classroom", "continuous_integration"),
}

# Folder of the site: title, content, and pages in order (by file name, in any package).
KINDS = {
    "tutorials": (
        "Tutorials",
        "From nothing to a result, a quarter of an hour each. A test types every command that ends by itself.",
        ("first_run", "own_controller", "own_package", "own_drive", "tune", "test_bench", "realtime", "question",
         "board_tutorial"),
    ),
    "how-to": (
        "How-to guides",
        "You know what you want to do; here is how.",
        tuple(name for names in GUIDES.values() for name in names),
    ),
    "notebooks": (
        "Notebooks",
        "For teaching, half an hour each, with exercises: a motor, a solar string, a robot, a network.",
        ("notebook_drive", "notebook_power", "notebook_robot", "notebook_network"),
    ),
    "explanations": (
        "Explanations",
        "Why it is as it is, and what you can rely on.",
        ("idea", "lockstep", "tick", "house", "placements", "bits", "numerics", "verdicts", "solver"),
    ),
    "reference": (
        "Reference",
        "Everything by name; most of it is made from the code.",
        ("scenario_file", "names", "file_formats", "model_kit", "licences"),
    ),
    "lab": (
        "Laboratory",
        "Measurements of single days: speed, starts, memory, strength of the tests.",
        ("placements_measured", "native_measured", "bags_measured", "against", "peers", "ros_tools", "tests"),
    ),
}  # fmt: skip


# Words for the search that the page does not have.
KEYWORDS = {
    "send": "colleague, share, zip, archive, exchange, reproduce, repeat",
    "strangers": "security, trust, sandbox, signature, untrusted, confirm",
    "upgrade": "update, migrate, migration, pull, newer, version, release",
    "paper_figures": "latex, pgf, tikz, publication, matplotlib, thesis",
    "continuous_integration": "junit, ci, github, gitlab, jenkins, regression",
    "own_controller": "own, my, custom, controller, c++, foreign, node",
    "own_package": "own, my, custom, plant, model, pendulum, template, new",
    "own_drive": "pmsm, data sheet, datasheet, c, firmware, inverter, dead time, drive, servo",
    "dc_motor_smc": "overshoot, speed, chattering",
    "view": "gui, live, slider, dashboard, knob, browser",
    "tune": "gains, optimise, optimize, overshoot, pid, tuning",
    "test_bench": "requirement, stl, fault, falsify, injection, hil",
    "set_up": "install, installation, pip, offline, windows, docker",
    "studies": "sweep, monte, carlo, grid, batch, parallel, statistics, confidence, sobol, slurm, dask",
    "c_law": "c, c++, rust, fortran, static, shared library, drive, dll",
    "cpp_node": "c++, cmake, rclcpp, colcon, qos",
    "own_robot": "urdf, xacro, arm, manipulator, robot description",
    "classroom": "course, students, teaching, lecturer, marks, grading, windows, wsl",
    "learning": "gym, gymnasium, reinforcement, agent, rl",
    "linear_view": "bode, nyquist, poles, margin, linearize, eigenvalues",
    "names": "vocabulary, glossary, simulink, units, jointstate, ampere, volt, renamed, alias, deprecated",
    "file_formats": "urdf, comtrade, fmu, csv, tags, columns, mimic, damping, friction",
    "outside_tools": "plotjuggler, foxglove, rviz, gif, video, animation",
    "board_tutorial": "arduino, uno, firmware, serial, simavr, hil",
    "boards": "serial, arduino, uno, link, loop, simavr, qemu, hil",
    "hardware": "c, embedded, arduino, microcontroller, export, firmware, misra",
    "plc": "plc, iec 61131, structured text, codesys, twincat, plcopen, function block",
    "bags": "rosbag, mcap, record, replay",
    "realtime": "hardware, loop, hil, latency, wall, clock",
}


class System(NamedTuple):
    """How the gallery sorts a system, and the content of its card.

    Field, methods, a scenario of another machine than the paper's.
    """

    field: str
    methods: tuple[str, ...]
    another: str


SYSTEMS = {
    "dc_motor_smc": System("drive", ("sliding mode", "PID", "observer"), "dc_motor_smc_re40"),
    "dc_motor_fsfb": System("drive", ("state feedback", "predictor", "observer"), "dc_motor_fsfb_ctms"),
    "induction_dtc": System("drive", ("switching table",), "induction_dtc_4kw"),
    "lsrm_fuzzy": System("drive", ("fuzzy", "PID"), "lsrm_fuzzy_relay"),
    "pv_mppt": System("power", ("search",), "pv_mppt_kc200gt"),
    "rectifier_mpc": System("power", ("predictive",), "rectifier_mpc_10kva"),
    "gupfc": System("power", ("PID",), "gupfc_345kv"),
    "fault_location": System("power", ("estimation", "search"), "fault_location_500kv"),
    "economic_dispatch": System("power", ("optimal", "search"), "economic_dispatch_wood"),
    "manipulator_adsmc": System("robot", ("sliding mode", "adaptive"), "manipulator_adsmc_siciliano"),
    "rehab_impedance": System("robot", ("impedance",), "rehab_impedance_winter"),
    "tcp_aqm": System("network", ("sliding mode", "PID"), "tcp_aqm_smc_hollot"),
    "optimal_control_mvim": System("theory", ("optimal",), "optimal_control_mvim_wie"),
    "pwa_delay": System("theory", ("stability proof", "state feedback"), "pwa_delay_hayes"),
}

# Machines and converters with textbook controllers: they reproduce no paper, so they have no claims.
MACHINES = {
    "pmsm_foc": System("machines", ("field orientation",), "pmsm_foc_servo"),
    "im_foc": System("machines", ("field orientation",), "im_foc_4kw"),
    "bldc_six_step": System("machines", ("six-step",), "bldc_six_step_anaheim"),
    "buck_pi": System("power", ("PID",), "buck_pi_boost"),
    "arm_computed_torque": System("robot", ("computed torque", "impedance"), "arm_computed_torque_three"),
}
GALLERY = SYSTEMS | MACHINES


@cache
def pages() -> dict[str, Path]:
    """Find the pages and notebooks of the packages by file name."""
    return {page.stem: page for page in sorted(ROOT.glob("ros_pkgs/*/doc/**/*.*")) if page.suffix in (".md", ".ipynb")}


@cache
def places() -> dict[Path, str]:
    """Describe the place of each page on the site, without suffix; a page without a place is a how-to guide.

    Raises
    ------
    ValueError
        A place has no page.
    """
    results = {name: f"{kind}/{name}" for kind, (_, _, names) in KINDS.items() for name in names}
    results |= {name: f"gallery/{name}" for name in GALLERY}
    if lost := sorted(results.keys() - pages().keys()):
        raise ValueError(f"{', '.join(lost)}: named in scripts/docs/outline.py, but no package has such a page in doc/")
    results = {name: f"how-to/{name}" for name in pages()} | results
    return {page: results[name] for name, page in pages().items()}


def title(page: Path) -> str:
    """Return the title of a page or notebook."""
    match = re.search(r"^# (.+)$", _beginning(page), re.M)
    assert match, f"{page} has no title"
    return match[1]


def opening(page: Path) -> str:
    """Return the first sentence of a page or notebook; empty if it does not begin with one."""
    paragraphs = re.split(r"\n\s*\n", _beginning(page).partition("\n")[2].partition("\n## ")[0])
    texts = (" ".join(p.split()) for p in paragraphs if re.match(r"\s*(?!```)[A-Z`*]", p))
    first = next((re.split(r"(?<=[.:!?]) (?=[A-Z(`*]|softrig)", text)[0] for text in texts), "")
    return re.sub(r":$", ".", first)


def _beginning(page: Path) -> str:
    text = page.read_text(encoding="utf-8")
    return "".join(json.loads(text)["cells"][0]["source"]) if page.suffix == ".ipynb" else text
