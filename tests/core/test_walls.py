"""Which module may import which; every import counts, also those inside functions."""

import ast
from functools import cache
from pathlib import Path

import pytest
from pages.statements import imported

PACKAGES = Path(__file__).parents[2] / "ros_pkgs"
DOMAINS = ("softrig_drives", "softrig_power", "softrig_robots", "softrig_systems")
INTERFACES = ("std_msgs", "sensor_msgs", "geometry_msgs", "diagnostic_msgs", "visualization_msgs", "trajectory_msgs")
MIDDLEWARE = ("rclpy", "rcl_interfaces", "std_srvs", "rosgraph_msgs", "builtin_interfaces", *INTERFACES)
# Rooms from the bottom up: a module imports only from its own room and the rooms before it. Ports know their wire
# layout, so bytes and types of messages are below the blocks.
ROOMS = {
    "softrig_core": (
        "errors arrays arrow bits timebase data entry guard interrupt needs extras renamed command_line runners kit "
        "wire judge block motion former board native solver scenario rig verdict run drawing analysis export firmware"
    ),
    "softrig_nodes": "below processes seam ros adapter lockstep realtime face group rehearsal main container preloaded",
    "softrig_bags": (
        "errors content files tables read messages pairing compare align scenery health info export write repair tape "
        "live cli"
    ),
    "softrig_bringup": (
        "folder terminal pack options page plots film report run study falsify view new results verbs launched cli "
        "__main__"
    ),
}
LAYERS = {f"{package}.{room}": k for package, rooms in ROOMS.items() for k, room in enumerate(rooms.split())}


def imports(package, types=True):
    """Module name to the modules that it imports, relative ones resolved; without those for type checking only."""
    result = {}
    for file in sorted((PACKAGES / package / package).rglob("*.py")):
        parts = file.relative_to(PACKAGES / package).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        inside = parts[:-1]  # base of relative imports
        targets = set()
        for node, only_types in imported(file):
            if only_types and not types:
                continue
            if isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
            else:
                base = ".".join([*inside[: len(inside) - node.level + 1], *([node.module] if node.module else [])])
                base = base if node.level else node.module
                targets |= {f"{base}.{alias.name}" for alias in node.names}
        result[name] = targets
    return result


@cache
def everything():
    """By package; not all together, which would take a second of each worker's time."""
    return {package.name: imports(package.name) for package in sorted(PACKAGES.glob("softrig_*"))}


def within(module, *prefixes):
    return any(module == p or module.startswith(p + ".") for p in prefixes)


def layer(module):
    """The layer of a module: that of the longest matching prefix."""
    names = [name for name in LAYERS if within(module, name)]
    return LAYERS[max(names, key=len)] if names else None


def test_the_check_finds_imports():
    assert any(within(t, "rclpy") for t in everything()["softrig_nodes"]["softrig_nodes.ros.ros"])
    assert "softrig_core.wire.types.TYPES" in everything()["softrig_core"]["softrig_core.block.port"]
    assert "casadi" in everything()["softrig_core"]["softrig_core.kit.compiled"]  # an import within a function counts
    assert (
        layer("softrig_core.wire.signals")
        < layer("softrig_core.block.codec")
        < layer("softrig_core.solver.worker.Work")
    )
    assert layer("softrig_nodes.seam.tick") < layer("softrig_nodes.main")


def test_only_the_nodes_package_uses_the_middleware():
    bags = [f"softrig_bags.{name}" for name in ("live.recorder", "live.player", "live.ros")]
    may = ("softrig_nodes", *bags)
    breaches = [
        f"{module} imports {target}"
        for modules in everything().values()
        for module, targets in modules.items()
        for target in sorted(targets)
        if within(target, *MIDDLEWARE) and not within(module, *may)
    ]
    assert breaches == []


@pytest.mark.parametrize("package", ROOMS)
def test_a_package_folder_imports_only_those_below_it(package):
    result = everything()[package]
    assert [m for m in result if m != package and layer(m) is None] == []  # every module is in a room
    breaches = [
        f"{module} imports {target}"
        for module, targets in result.items()
        for target in sorted(targets)
        if within(target, package)
        and layer(module) is not None
        and layer(target) is not None
        and layer(target) > layer(module)
    ]
    assert breaches == []


def test_no_folder_has_more_modules_than_a_person_can_survey():
    crowded = {
        str(folder.relative_to(PACKAGES)): count
        for package in PACKAGES.glob("softrig_*")
        for folder in [package / package.name, *(package / package.name).rglob("*/")]
        if (count := len([f for f in folder.glob("*.py") if f.stem != "__init__"])) > 16
    }
    assert crowded == {}


@pytest.mark.parametrize(
    "place",
    ["softrig_core", "softrig_nodes", "softrig_control", "softrig_optim", "softrig_bags", "softrig_bringup", *DOMAINS],
)
def test_no_module_imports_itself_through_others(place):
    """Two modules that import each other are one module in two files; importing a type in the same folder is
    allowed.
    """
    results = {}
    for module, targets in imports(place, types=False).items():
        room = module.rpartition(".")[0]
        results[module] = targets | {t for t in everything()[place][module] if not within(t, room)}
    homes = {m: {t if t in results else t.rpartition(".")[0] for t in targets} for m, targets in results.items()}
    left = {m: targets & results.keys() - {m} for m, targets in homes.items()}
    while free := {m for m, targets in left.items() if not targets & left.keys()}:
        left = {m: targets for m, targets in left.items() if m not in free}
    assert left == {}


@pytest.mark.parametrize("package", DOMAINS)
def test_domain_packages_and_their_systems_are_independent(package):
    systems = {f"{package}.{p.parent.name}" for p in (PACKAGES / package / package).glob("*/__init__.py")}
    assert systems
    breaches = []
    for module, targets in everything()[package].items():
        others = [d for d in DOMAINS if d != package]
        own = next((s for s in systems if within(module, s)), None)
        for target in sorted(targets):
            hit = next((s for s in systems if within(target, s)), None)
            if within(target, *others) or (hit is not None and hit != own and hit not in SHARED):
                breaches.append(f"{module} imports {target}")
    assert breaches == []


SHARED = {"softrig_power.lines", "softrig_power.baselines"}  # sub-packages that several systems use


def test_packages_depend_one_way():
    below = {
        "softrig_core": (),
        "softrig_control": ("softrig_core",),
        "softrig_optim": ("softrig_core", "softrig_control"),
    }
    below |= dict.fromkeys(DOMAINS, ("softrig_core", "softrig_control", "softrig_optim"))
    below["softrig_power"] += ("softrig_bags",)  # `locate` reads a record from a bag
    below["softrig_nodes"] = ("softrig_core",)
    below["softrig_bags"] = ("softrig_core", "softrig_nodes")
    breaches = [
        f"{module} imports {target}"
        for package, allowed in below.items()
        for module, targets in everything()[package].items()
        for target in sorted(targets)
        if target.startswith("softrig_") and not within(target, package, *allowed)
    ]
    assert breaches == []


def test_no_dataclass_has_a_default_that_python_3_11_refuses():
    """There a mapping proxy has no hash, and a field without one is a mutable default, so nothing could be imported."""
    refused = []
    for path in PACKAGES.glob("*/softrig_*/**/*.py"):
        if "MappingProxyType({" not in (text := path.read_text()):
            continue
        for made in ast.walk(ast.parse(text)):
            if isinstance(made, ast.ClassDef) and any("dataclass" in ast.unparse(d) for d in made.decorator_list):
                fields = [f for f in made.body if isinstance(f, ast.AnnAssign) and f.value is not None]
                refused += [f"{path.name}: {made.name}" for f in fields if "MappingProxyType(" in ast.unparse(f.value)]
    assert not refused
