"""Code that decides a number uses no BLAS, no LAPACK, no transcendental function of numpy: their bits depend on the
CPU; and no built-in `sum`, whose bits depend on the version of Python. Numpy's sums of arrays are allowed: they add in
one order at every level, and on arm64. So are `math.fsum`, which is exact, and `functools.reduce`, whose order is
fixed.

`jit` refuses them in what it compiles; here they are refused in plants, laws and solvers. The same reading of the
sources finds the functions of the C library that they call: `bits.math_digest` is of those. Not seen by this rule:
products of complex arrays, which numpy fuses on some CPUs (`softrig_core.kit.dense.times`); the golden rigs under
other kernels see them.
"""

import ast
import math
import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import pytest
from softrig_core import bits

PACKAGES = Path(__file__).parents[2] / "ros_pkgs"
DECIDING = ("core", "nodes", "control", "optim", "drives", "power", "robots", "systems")
# numpy.sin and numpy.cos are the C library's at every level (test_bits.py), as are hypot, sqrt and arithmetic
_REFUSED = """linalg dot vdot inner matmul tensordot einsum convolve correlate polyfit polyval roots poly polynomial cov
corrcoef exp expm1 exp2 log log1p log2 log10 tan arcsin arccos arctan arctan2 sinh cosh tanh arcsinh arccosh arctanh
cbrt power float_power angle logspace geomspace fft vecdot matvec vecmat"""
REFUSED = frozenset(_REFUSED.split())
OTHERS = frozenset({"dot", "sumprod"})  # methods of arrays, functions of math
NOTHING: frozenset[str] = frozenset()
OF = {"np": REFUSED, "numpy": REFUSED, "math": OTHERS, "ca": NOTHING, "casadi": NOTHING}
# Modules that judge or show recorded values, which cannot affect a run.
WHOLE = ("figures", "pictures", "drawing", "study", "study_tool", "cases")
# Functions with the same bits on every CPU with IEEE 754.
_EXACT = """ceil copysign degrees fabs floor fmod frexp fsum gcd inf isclose isfinite isinf isnan lcm ldexp
modf nan nextafter pi prod radians remainder sqrt tau trunc ulp"""
EXACT = frozenset(_EXACT.split())
# Functions of the C library that each function of cmath uses.
PARTS = {"phase": {"atan2"}, "polar": {"atan2", "hypot"}, "rect": {"sin", "cos"}}
COUNT = "a sum of whole numbers (sizes of ports, ...), or whether one is finite"
CASADI = "casadi's own products, unrolled into scalar operations"
CHECK = "a check or a certificate: its verdict is compared with a margin, no number of a run comes from it"
SOLVER = "a solver of others (IPOPT, SCS, SuperLU), which brings its own algebra: pinned kernels are all there is"
INTEGERS = "sums and products of Python's integers and fractions, which do not round"
SCALAR = "scipy's scalar search or quadrature, or a tridiagonal solve: no kernels chosen by CPU"
EXEMPT = {
    "softrig_control.c_member": COUNT,
    "softrig_control.fmu.description": COUNT,
    "softrig_control.fmu.instance": COUNT,
    "softrig_control.predictive.certificate": CHECK,
    "softrig_control.predictive.certificate_node": CHECK,
    "softrig_control.predictive.gpc.Gpc.poles": CHECK,
    "softrig_control.state_feedback.closed_loop_poles": CHECK,
    "softrig_control.transfer.Exact.polynomials": INTEGERS,
    "softrig_core.analysis.crossings": "looks at a rig from outside",
    "softrig_core.analysis.environment.RigEnv.published": COUNT,
    "softrig_core.analysis.environments.RigVectorEnv._places": COUNT,
    "softrig_core.analysis.linear_view": "looks at a rig from outside",
    "softrig_core.analysis.state_map.StateMap.follows": COUNT,
    "softrig_core.analysis.steady": "looks at a rig from outside",
    "softrig_core.bits.blas_core": "asks which BLAS is loaded",
    "softrig_core.block.answer": "whether values are below a bound",
    "softrig_core.export": "writes C, and draws the inputs of its test",
    "softrig_core.judge.measures.growth_rate": "judges what was recorded",
    "softrig_core.judge.measures.shared": COUNT,
    "softrig_core.kit.exact": INTEGERS,
    "softrig_core.native.calls": "the word itself: of whole numbers it is translated, of others it stays Python's",
    "softrig_core.native.fitted.Fitted.size": COUNT,
    "softrig_core.native.turns": COUNT,
    "softrig_core.run.simulate.Run.__repr__": COUNT,
    "softrig_core.scenario.yaml_file": COUNT,
    "softrig_core.wire": COUNT,
    "softrig_drives.lsrm.profile.Quintic.speed_range": CHECK,
    "softrig_nodes": COUNT,
    "softrig_optim.sweep": COUNT,
    "softrig_power.dispatch.baselines": SCALAR,
    "softrig_power.dispatch.certify": "seconds of the wall clock",
    "softrig_power.fault_location.method.confidence": CHECK,
    "softrig_power.fault_location.method.ends._least": SCALAR,
    "softrig_power.fault_location.locator.FaultLocator.setup": SCALAR,
    "softrig_power.fault_location.method.search.brent": SCALAR,
    "softrig_power.gupfc.steady.start": "numpy's Fourier transform: one build for all x86-64, another for arm64",
    "softrig_robots.arm.model.compile_arm": CASADI,
    "softrig_robots.driven_robot._equations": CASADI,
    "softrig_robots.rehab.stability": CHECK,
    "softrig_robots.urdf_file._check_body": CHECK,
    "softrig_robots.rigid_body": CASADI + "; moments of inertia are checked",
    "softrig_systems.optimal_control.method.collocation": SOLVER,
    "softrig_systems.optimal_control.evaluator.OcpEvaluator._updated": SCALAR,
    "softrig_systems.optimal_control.method.exact": CHECK,
    "softrig_systems.optimal_control.player.OcpPlayer._with_plan": SCALAR,
    "softrig_systems.optimal_control.problem": CASADI + "; weights are checked",
    "softrig_systems.optimal_control.problems": CHECK,
    "softrig_systems.pwa_delay.proof.applicability": CHECK,
    "softrig_systems.pwa_delay.proof.bessel_legendre": SOLVER,
    "softrig_systems.pwa_delay.proof.certify": CHECK,
    "softrig_systems.pwa_delay.proof.lmi": SOLVER,
    "softrig_systems.pwa_delay.search": CHECK,
    "softrig_systems.pwa_delay.system.PwaSystem._check_cover": CHECK,
    "softrig_systems.pwa_delay.system.PwaSystem._check_features": CHECK,
    "softrig_systems.pwa_delay.system.PwaSystem.faces": CHECK,
    "softrig_systems.pwa_delay.system.PwaSystem.on_face": CHECK,
    "softrig_systems.pwa_delay.system.from_lines": CHECK,
    "softrig_systems.pwa_delay.proof.theorem1": SOLVER,
}


def counts(call: ast.Call) -> bool:
    """Return whether a `sum` can only be one of integers: of comparisons, ones, lengths."""
    of = call.args[0]
    term = of.elt if isinstance(of, (ast.GeneratorExp, ast.ListComp)) else of
    return (
        isinstance(term, ast.Compare)
        or (isinstance(term, ast.Constant) and isinstance(term.value, int))
        or (isinstance(term, ast.Call) and ast.unparse(term.func) == "len")
    )


# A superset of what `uses` detects, as a pattern: files without a match are not parsed, which would take most of the
# time.
SEEN = re.compile(
    rf"""(?<!\.)\bsum\b | @[ ] | \S.*@ | \.\s*(?:{"|".join(OTHERS)})\b
    | \b(?:np|numpy)\s*\.\s*(?:{"|".join(REFUSED)})\b | \bscipy\b | \bimport\b.*\bnumpy\b(?!\ as\ np\b)
    | \bfrom\s+(?:numpy|math)\s+import\s(?:[^(\n]*|\s*\([^)]*)\b(?:{"|".join(REFUSED | OTHERS)})\b""",
    re.VERBOSE,
)


def uses(module: str, source: str) -> set[str]:
    """Where a module uses something forbidden: qualified names of the functions or classes."""
    result: set[str] = set()
    if not SEEN.search(source):
        return result
    whole: set[ast.expr] = set()  # calls of `sum` over whole numbers, which are exact
    waiting: list[tuple[ast.AST, str]] = [(ast.parse(source), module)]
    while waiting:
        node, where = waiting.pop()
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            where = f"{where}.{node.name}"
        elif isinstance(node, (ast.BinOp, ast.AugAssign)):
            if isinstance(node.op, ast.MatMult):
                result.add(where)
        elif isinstance(node, ast.Attribute):
            home = node.value.id if isinstance(node.value, ast.Name) else ""
            if node.attr in OF.get(home, OTHERS):
                result.add(where)
            if node.attr == "LinAlgError":  # `except np.linalg.LinAlgError` and raising it compute nothing
                continue
        elif isinstance(node, ast.Call):
            if getattr(node.func, "id", "") == "sum" and counts(node):
                whole.add(node.func)
        elif isinstance(node, ast.Name):
            if node.id == "sum" and node not in whole:  # also `sum` as an argument: `map(sum, rows)`
                result.add(where)
            continue
        elif isinstance(node, ast.ImportFrom):
            home, names = node.module or "", {a.name for a in node.names}
            if home.startswith(("scipy", "numpy.linalg", "numpy.fft")) or names & OF.get(home, NOTHING):
                result.add(where)
        elif isinstance(node, ast.Import):
            for a in node.names:
                if a.name.startswith(("scipy", "numpy.")) or (a.name == "numpy" and a.asname not in (None, "np")):
                    result.add(where)
        for child in ast.iter_child_nodes(node):
            # Half of all nodes are constants or contexts, which use nothing.
            if not isinstance(child, (ast.Constant, ast.expr_context)):
                waiting.append((child, where))
    return result


MODULES = ("cmath", "math", "ca", "casadi", "np", "numpy")
CALLS = re.compile(rf"\b({'|'.join(MODULES)})\s*\.\s*(\w+)")
NAMED = re.compile(rf"\bfrom\s+({'|'.join(MODULES)})\s+import\s+(\([^)]*|.*)")


def functions(home: str, name: str) -> tuple[set[str], set[str]]:
    """The functions of the C library that a name of a module uses: real, complex."""
    if home == "cmath":
        return PARTS.get(name, set()), {name} - EXACT - PARTS.keys() | {name} & {"sqrt"}
    return {name} - EXACT if hasattr(math, name) else set(), set()


def calls(source: str) -> set[tuple[str, str]]:
    """The calls of a module itself, in CasADi's C or from numpy: names with their modules."""
    result: set[tuple[str, str]] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            result.add((node.value.id, node.attr))
        elif isinstance(node, ast.ImportFrom):
            result |= {(node.module or "", a.name) for a in node.names}
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
            result.add(("math", "pow"))
    return {(home, name) for home, name in result if home in MODULES}


def called(sources: Iterable[str]) -> tuple[set[str], set[str]]:
    """The functions of the C library that modules call: real, complex."""
    pairs: set[tuple[str, str]] = set()
    for source in sources:
        written = {*CALLS.findall(source)} | ({("math", "pow")} if "**" in source else set())
        written |= {(home, name) for home, names in NAMED.findall(source) for name in re.findall(r"\w+", names)}
        # Skip files in which no new function can be called.
        if any(any(functions(*pair)) for pair in written - pairs):
            pairs |= calls(source)
    both = [functions(*pair) for pair in pairs]
    return set().union(*(real for real, _ in both)), set().union(*(whole for _, whole in both))


@cache
def deciding() -> dict[str, str]:
    """The syntax tree of each module that decides numbers."""
    result: dict[str, str] = {}
    for short in DECIDING:
        root = PACKAGES / f"softrig_{short}"
        for file in sorted((root / root.name).rglob("*.py")):
            place = file.relative_to(root).with_suffix("").parts
            if file.stem not in WHOLE and "drawing" not in place:
                result[".".join(place)] = file.read_text()
    return result


@cache
def found() -> dict[str, str]:
    """Each use with its exemption, empty if there is none."""
    names: dict[str, str] = {}
    for module, source in deciding().items():
        for name in uses(module, source):
            names[name] = next((e for e in EXEMPT if name == e or name.startswith(f"{e}.")), "")
    return names


def test_code_that_decides_the_bits_uses_nothing_that_depends_on_the_cpu():
    assert sorted(name for name, exempt in found().items() if not exempt) == []


def test_the_digest_covers_exactly_the_functions_in_use():
    """More would distinguish machines that give the same bits, and fewer would not notice a difference."""
    real, whole = called(source for module, source in deciding().items() if module != "softrig_core.bits")
    assert real == {*bits.FUNCTIONS, *bits.OF_TWO}
    assert whole == {*bits.COMPLEX}


def test_no_exemption_outlives_its_reason():
    assert sorted(set(EXEMPT) - set(found().values())) == []


@pytest.mark.parametrize(
    ("code", "refused"),
    [("def law(x):\n    return K @ x", True), ("y = np.linalg.norm(x)", True), ("y = x.T.dot(y)", True),
     ("def f(x):\n    return np.exp(x)", True), ("from scipy.linalg import solve", True), ("a @= b", True),
     ("import numpy.linalg", True), ("y = np.sin(x) + np.sqrt(x) * np.hypot(x, x)", False), ("y = math.exp(x)", False),
     ("try:\n    f()\nexcept np.linalg.LinAlgError:\n    pass", False), ("y = ca.dot(x, x)", False),
     ("y = dense.product(K, x)", False), ("y = sum(a * b for a, b in pairs)", True), ("y = sum(row)", True),
     ("y = x.dot(z)", True), ("y = np.fft.fft(x)", True), ("from numpy import dot", True), ("y = map(sum, rows)", True),
     ("from math import sumprod", True), ("import numpy as xp", True), ("from math import fsum, exp", False),
     ("from numpy import sqrt", False), ("y = x.sum() + np.sum(x)", False), ("n = sum(len(r) for r in x)", False),
     ("y = dense.total(row)", False), ("n = sum(x > 0.0 for x in row)", False), ("y = math.sumprod(a, b)", True),
     ("x = sum(p.size for p in waves)", True)],
)  # fmt: skip
def test_the_rule_finds_forbidden_uses(code, refused):
    assert bool(uses("module", code)) == refused
