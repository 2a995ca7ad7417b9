"""Formulas of signal temporal logic: parsed, and checked against the names in a rig.

The grammar is that of `sentil`. softrig adds words for conditions (a bare name, ``rising(x)``, ``falling(x)``,
``changed(x)``), whole nanoseconds in place of seconds, units, and the evaluation over a record (`robustness`).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache, reduce
from typing import Any

import numpy as np

from ..errors import ScenarioError, closest
from ..extras import need
from ..timebase import SECOND
from .arithmetic import ARITHMETIC, SEVERAL, Tree, arithmetic, called, literal, sure
from .expression import REFERENCE, number
from .units import powers, text

# The longest interval, in s.
LONGEST = 1e9
EDGES = {"rising": np.greater, "falling": np.less, "changed": np.not_equal}
_WORDS = {"always", "eventually", "until", "since", "once", "historically", "next", "not", "and", "or", "implies"}
# sentil may read these letters as operators, so they cannot be names.
_LETTERS = {"G", "F", "U", "R", "H", "O", "S", "X", "Y", "P"}
_CALLS = {"abs", "min", "max", "sqrt", "exp", "log", "ln", "sin", "cos", "tan", "floor", "ceil"}
_TOKEN = re.compile(r"\s*([A-Za-z_]\w*|\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?|->|[<>=!]=|&&|\|\||\S)")
_INTERVAL = re.compile(r"\[([^\[\],]+),([^\[\],]+)\]")
_PLAIN = re.compile(r"\s*(?:\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?|inf)\s*")
_NAME = re.compile(r"(?<![\w.])[A-Za-z_]\w*")
_AFTER_CONDITION = {"->", "and", "or", "until", "since", "implies", ")", "&", "|", "&&", "||", ""}
REMEMBERED = 1 << 14  # parts of formulas whose variables are remembered; then all are forgotten, which bounds memory
_names: dict[int, tuple[Any, list[str]]] = {}
FUTURE, PAST = ("Always", "Eventually"), ("Historically", "Once")


@dataclass(frozen=True)
class Condition:
    """A variable that is true or false: a signal above one half, or an edge of it."""

    signal: str
    edge: str = ""

    @property
    def variable(self) -> str:
        """Its name in the formula that sentil parses."""
        return f"_{self.edge or 'true'}__{self.signal}"


def named(reference: str) -> str:
    """Return the name by which a parsed formula has a reference ``node.parameter``: ``node__parameter``."""
    return reference.replace(".", "__")


def with_names(formula: str) -> str:
    """Return a formula with names in place of its references: ``$motor.R`` becomes ``motor__R``."""
    return REFERENCE.sub(lambda match: named(match[1]), formula)


@lru_cache(maxsize=256)
def timing(formula: str) -> frozenset[str]:
    """Return the names in a formula's intervals."""
    return (
        frozenset({name for result in _INTERVAL.finditer(formula) for name in _NAME.findall(result[0])})
        - _CALLS
        - {"inf"}
    )


def _compares_number(kind: str, body: Any, units: Mapping[str, str]) -> bool:
    if kind == "Predicate":
        sides = [body["lhs"], body["rhs"]]
    elif kind == "Binary" and body[0] in ("Add", "Sub"):
        sides = body[1:]
    else:
        return False
    alone = [side for side in sides if not variables(side)]
    names = [name for side in sides for name in variables(side)]
    if not alone or not names or not any(arithmetic(side, {}) for side in alone):
        return False
    return any(units.get(name, "") for name in names)


def read(formula: str, known: Mapping[str, float | None]) -> tuple[Tree, dict[str, Condition]]:
    """Read a formula.

    Parameters
    ----------
    formula : str
        Such as ``always (fault -> eventually[0, 0.05] abs(current) < 0.1)``, times in s: numbers, or arithmetic over
        names of numbers.
    known : mapping
        Values of its names: a number, or None for a signal. References count as names (`with_names`).

    Returns
    -------
    tree : plain data
        With intervals in ns, numbers filled in.
    conditions : dict
        By variable.

    Raises
    ------
    ScenarioError
        The formula cannot be parsed, or a name is unknown (the message suggests the nearest one).
    """
    tree, conditions = _read(formula, tuple(known.items()))
    return tree, dict(conditions)


@lru_cache(maxsize=256)
def _read(formula: str, items: tuple[tuple[str, float | None], ...]) -> tuple[Tree, Mapping[str, Condition]]:
    result = outline(formula, known := dict(items))
    numbers = {name: value for name, value in known.items() if value is not None}
    tree = _map(result.tree, lambda k, body: (k, numbers.get(body, body) if k == "Literal" else body))
    return tree, result.conditions


@dataclass(frozen=True, eq=False)
class Outline:
    """A formula with names in place of its numbers, so that variants of a rig with other numbers share it.

    Parameters
    ----------
    formula : str
        The formula as it was written.
    parsed, tree : plain data
        As sentil reads it; and with intervals in ns, and a literal with a name for the number of this name.
    conditions : mapping
        By variable.
    """

    formula: str
    parsed: Tree
    tree: Tree
    conditions: Mapping[str, Condition]

    @cached_property
    def variables(self) -> list[str]:
        """Return the names of its signals and conditions."""
        return variables(self.tree)

    @cached_property
    def numbers(self) -> list[str]:
        """Return the names of its numbers."""
        return [body for kind, body in nodes(self.tree) if kind == "Literal" and isinstance(body, str)]

    @cached_property
    def intervals(self) -> list[tuple[float, float | None]]:
        """Return the interval of every temporal operator, ns."""
        return list(intervals(self.tree))

    @cached_property
    def _constants(self) -> list[tuple[Tree, bool]]:
        """Return the largest parts without a signal, and whether something is divided by each."""
        result = []
        for kind, body in nodes(self.tree):
            parts = [*body.values()] if kind == "Predicate" else called(kind, body)[1] if kind in _OPERATIONS else []
            divides = kind == "Binary" and body[0] in ("Div", "Mod")
            if kind == "Predicate" or (kind in _OPERATIONS and variables(body)):
                result += [
                    (part, divides and k == 1)
                    for k, part in enumerate(parts)
                    if isinstance(part, dict) and not variables(part)
                ]
        return result

    def has_bounds(self, units: Mapping[str, str]) -> bool:
        """Return whether it has bounds of its own, which do not follow the machine.

        These are times other than 0 that are written as numbers, and numbers with a unit: a comparison of something
        that has a unit with a number alone, or a sum of the two. Shares of what is named, and zero, follow.

        Parameters
        ----------
        units : mapping
            Of the names that are no numbers.
        """
        times = [part.strip() for result in _INTERVAL.finditer(self.formula) for part in result.groups()]
        if any(part != "inf" and float(part) for part in times if _PLAIN.fullmatch(part)):
            return True
        return any(_compares_number(kind, body, units) for kind, body in nodes(self.parsed))

    def check(self, numbers: Mapping[str, Any]) -> None:
        """Refuse constants that are not finite for any signals; a ScenarioError says what is undefined."""
        with np.errstate(all="ignore"):
            for tree, divides in self._constants:
                if not _constant(tree, numbers) and divides:
                    raise ScenarioError("a division by zero")


_OPERATIONS = ("Call", "Binary")


def _constant(tree: Tree, numbers: Mapping[str, Any]) -> Any:
    """Return the value of an expression without signals; refuse it where one of its parts is undefined."""
    ((kind, body),) = tree.items()
    if kind == "Literal":
        return literal(body, numbers)
    name, operands = called(kind, body)
    values = [_constant(part, numbers) for part in operands]
    if name in ("Div", "Mod") and not values[1]:
        raise ScenarioError("a division by zero")
    result = sure(ARITHMETIC[name](*values))
    if math.isnan(result):
        raise ScenarioError(f"{body[0].lower()} of numbers for which it is undefined")
    return result


def outline(formula: str, known: Mapping[str, float | None]) -> Outline:
    """Read a formula as `read` does, but keep the names of its numbers; raise the same errors."""
    for name in sorted(_LETTERS & known.keys()):
        raise ScenarioError(f"formula {formula!r}: {name} is the letter of an operator; rename the signal or figure")
    names = tuple([(name, value is not None) for name, value in known.items()])
    timed = _timed(formula, known)
    # Whether an exponent is a whole number decides which unit its power has.
    exponents = {name: known[name] for name in _exponents(formula, timed, names)}
    result = _outline(formula, timed, names, tuple(exponents.items()))
    try:
        result.check({name: value for name in result.numbers if (value := known[name]) is not None})
    except ScenarioError as error:
        raise ScenarioError(f"formula {formula!r}: {error}") from None
    return result


@lru_cache(maxsize=256)
def _exponents(formula: str, timed: str, names: tuple[tuple[str, bool], ...]) -> list[str]:
    numbers, tree = {name for name, is_number in names if is_number}, _tree(formula, timed, names)[0]
    powers_ = [body[2] for kind, body in nodes(tree) if kind == "Binary" and body[0] == "Pow"]
    return [name for part in powers_ for name in variables(part) if name in numbers]


@lru_cache(maxsize=256)
def _outline(
    formula: str, timed: str, names: tuple[tuple[str, bool], ...], exponents: tuple[tuple[str, float | None], ...]
) -> Outline:
    parsed, conditions = _tree(formula, timed, names)
    if not any(kind in ("Always", "Eventually", "Until") for kind, _ in nodes(parsed)):
        raise ScenarioError(f"formula {formula!r} is about t = 0 only: write 'always (...)', or 'eventually (...)'")
    for kind, body in nodes(parsed):
        if kind in ("Probabilistic", "Next"):
            raise ScenarioError(
                f"formula {formula!r}: no {'probabilities' if kind != 'Next' else 'next'} here; "
                "say when by an interval, in s"
            )
        if kind == "Binary" and body[0] == "Pow" and _negated(body[1]):
            raise ScenarioError(f"formula {formula!r}: a minus before a power reads as (-x)^n; write 0 - (x^n), or x*x")
    numbers: dict[str, Any] = {name: name for name, is_number in names if is_number}
    numbers |= exponents
    try:
        tree = _map(parsed, lambda kind, body: _filled(kind, body, numbers))
        _check_calls(tree)
    except ScenarioError as error:
        raise ScenarioError(f"formula {formula!r}: {error}") from None
    return Outline(formula, parsed, tree, conditions)


@lru_cache(maxsize=256)
def _tree(formula: str, timed: str, names: tuple[tuple[str, bool], ...]) -> tuple[Tree, Mapping[str, Condition]]:
    """Parse a formula whose times are numbers; only which of its names are signals matters, not their numbers.

    Parameters
    ----------
    formula : str
        The formula as it was written.
    timed : str
        From `_timed`.
    names : tuple of (str, bool)
        Its names and whether each is a number.
    """
    need("sentil", "a requirement as a formula")
    import sentil

    written, conditions = _rewrite(timed, {name: 0.0 if is_number else None for name, is_number in names})
    try:
        return json.loads(sentil.Formula.parse(written).to_json()), conditions
    except sentil.SentilError as error:
        raise ScenarioError(f"formula {formula!r}: {_reason(error, written)}") from None


def _timed(formula: str, known: Mapping[str, float | None]) -> str:
    """Evaluate arithmetic over names in a formula's intervals."""
    used = {name: known.get(name) for name in timing(formula)}
    # An unknown name is an error, whose text suggests one of all known names; the cache has only those that are used.
    return _calculated(formula, known) if None in used.values() else _timed_by(formula, tuple(used.items()))


@lru_cache(maxsize=256)
def _timed_by(formula: str, numbers: tuple[tuple[str, float | None], ...]) -> str:
    return _calculated(formula, dict(numbers))


def _calculated(formula: str, known: Mapping[str, float | None]) -> str:
    def value(name: str) -> float:
        result = known.get(name)
        if result is None:
            numbers = [each for each, v in known.items() if v is not None]
            fault = "changes while the rig runs" if name in known else f"is unknown{closest(name, numbers)}"
            raise ScenarioError(f"formula {formula!r}: {name} in an interval {fault}; expected the name of a number")
        return result

    def seconds(part: str) -> str:
        if _PLAIN.fullmatch(part):
            return part
        try:
            actual = number(_NAME.sub(lambda name: name[0] if name[0] in _CALLS else f"${name[0]}", part), value)
        except ScenarioError as error:
            raise (
                error if str(error).startswith("formula") else ScenarioError(f"formula {formula!r}: {error}")
            ) from None
        if actual < 0.0:
            raise ScenarioError(f"formula {formula!r}: {part.strip()} is {actual:g} s; expected a time of at least 0 s")
        # sentil reads no exponents in an interval.
        return format(actual, ".12f").rstrip("0").rstrip(".")

    return _INTERVAL.sub(lambda actual: f"[{seconds(actual[1])}, {seconds(actual[2])}]", formula)


def _check_calls(tree: Tree) -> None:
    """Refuse functions with the wrong number of arguments."""
    for name, args in [body for kind, body in nodes(tree) if kind == "Call"]:
        several = name in SEVERAL
        if len(args) < 2 if several else len(args) != 1:
            raise ScenarioError(f"{name} takes {'two numbers or more' if several else 'one number'}, got {len(args)}")


def _reason(error: Exception, written: str) -> str:
    match = re.match(r"parse error at line 1, column (\d+): (.*)", str(error))
    if not match:
        return str(error)
    position = int(match[1]) - 1
    return f"{match[2]}, at {written[position : position + 12]!r}" if written[position:].strip() else match[2]


def _negated(tree: Tree) -> bool:
    return tree.get("Binary", [None])[0] == "Sub" and tree["Binary"][1] == {"Literal": 0.0}


def _rewrite(formula: str, known: Mapping[str, float | None]) -> tuple[str, dict[str, Condition]]:
    """Replace conditions by comparisons, because sentil does not support conditions."""
    tokens = _TOKEN.findall(formula)
    conditions: dict[str, Condition] = {}
    out: list[str] = []
    calls: list[bool] = []  # whether each open bracket is that of a function
    i = 0
    while i < len(tokens):
        token, following = tokens[i], tokens[i + 1] if i + 1 < len(tokens) else ""
        if token == "(":
            calls.append(bool(out) and out[-1] in _CALLS)
        elif token == ")" and calls:
            calls.pop()
        if token in EDGES and following == "(":
            if i + 3 >= len(tokens) or tokens[i + 3] != ")" or known.get(tokens[i + 2], 0.0) is not None:
                raise ScenarioError(f"formula {formula!r}: {token}(...) needs the name of a signal")
            condition, i = Condition(tokens[i + 2], token), i + 3
        elif _is_name(token) and known.get(token, 0.0) is None and _stands_alone(out, following, calls):
            condition = Condition(token)
        else:
            if _is_name(token) and token not in known and not (token in _CALLS and following == "("):
                names = [*known, *_WORDS, *EDGES, *_CALLS]
                have = f"; its names are {', '.join(known)}" if known else "; there are no shared names"
                raise ScenarioError(f"formula {formula!r}: {token!r} is not a name{closest(token, names)}{have}")
            out.append(token)
            i += 1
            continue
        conditions[condition.variable] = condition
        # The values of a condition are plus or minus infinity (`robustness.truth`), so 0 separates true from false.
        out += ["(", condition.variable, ">", "0", ")"]
        i += 1
    return " ".join(out), conditions


def _is_name(token: str) -> bool:
    return token not in _WORDS and token != "inf" and bool(re.fullmatch(r"[A-Za-z_]\w*", token))


def _stands_alone(before: list[str], following: str, calls: list[bool]) -> bool:
    """Return whether a name is a condition by itself: it is not part of an expression or comparison."""
    last = before[-1] if before else ""
    starts = last in ("", "(", "]", "->", "!", "&", "|", "&&", "||") or last in _WORDS
    return starts and following in _AFTER_CONDITION and not (calls and calls[-1])


def _filled(kind: str, body: Any, numbers: Mapping[str, Any]) -> tuple[str, Any]:
    if kind == "Variable" and body in numbers:
        return "Literal", numbers[body]
    if isinstance(body, list) and body and isinstance(body[0], dict) and "lower" in body[0]:
        low, high = body[0]["lower"], body[0]["upper"]
        limits = {"lower": _ns(low), "upper": None if high is None else _ns(high)}
        return kind, [limits, *body[1:]]
    return kind, body


def _ns(seconds: float) -> float:
    if seconds > LONGEST:
        raise ScenarioError(f"an interval up to {seconds:g} s; expected at most {LONGEST:g} s, or inf")
    return float(round(seconds * SECOND))


def nodes(tree: Tree) -> list[tuple[str, Any]]:
    """Return every operator, function, variable and number of a formula with its operands, from the root on."""
    result: list[tuple[str, Any]] = []
    # A stack in place of recursion, because a study evaluates this in every run.
    stack: list[tuple[str, Any]] = [("", tree)]
    while stack:
        kind, body = stack.pop()
        if kind[:1].isupper():
            result.append((kind, body))
        if isinstance(body, dict):
            stack.extend(reversed(body.items()))
        elif isinstance(body, list):
            stack.extend(("", part) for part in reversed(body))
    return result


def _map(tree: Tree, change: Callable[[str, Any], tuple[str, Any]]) -> Tree:
    """Copy a formula with every node changed, from the leaves up."""
    if isinstance(tree, dict):
        return dict(change(k, _map(v, change)) if k[:1].isupper() else (k, _map(v, change)) for k, v in tree.items())
    return [_map(part, change) for part in tree] if isinstance(tree, list) else tree


def horizon(tree: Tree) -> float:
    """Return how far into the future of an instant a formula looks, ns; open operators look to the record's end."""
    if isinstance(tree, list):
        return max(map(horizon, tree), default=0.0)
    if not isinstance(tree, dict):
        return 0.0
    deepest = 0.0
    for kind, body in tree.items():
        below = horizon(body)
        if kind in (*FUTURE, "Until"):
            below += body[0]["lower"] if body[0]["upper"] is None else body[0]["upper"]
        deepest = max(deepest, below)
    return deepest


def intervals(tree: Tree) -> Iterator[tuple[float, float | None]]:
    """Yield the interval of every temporal operator, ns."""
    for _, body in nodes(tree):
        if isinstance(body, list) and body and isinstance(body[0], dict) and "lower" in body[0]:
            yield body[0]["lower"], body[0]["upper"]


def variables(tree: Tree) -> list[str]:
    """Return the names of the variables of a formula, or of a part of one, each once."""
    if not isinstance(tree, dict | list):
        return []
    if id(tree) not in _names:
        if isinstance(tree, dict):
            parts = [[body] if kind == "Variable" else variables(body) for kind, body in tree.items()]
        else:
            parts = [variables(part) for part in tree]
        if len(_names) >= REMEMBERED:
            _names.clear()
        # The tree is stored too: while it lives, no other tree can have its id.
        _names[id(tree)] = tree, list(dict.fromkeys(name for part in parts for name in part))
    return _names[id(tree)][1]


def margin_unit(tree: Tree, units: Mapping[str, str], scale: Mapping[str, float]) -> tuple[Tree, str]:
    """Find the unit that a formula's margin has, and divide comparisons by their scale.

    Parameters
    ----------
    tree : plain data
    units : mapping
        Unit of each variable that is no condition.
    scale : mapping
        By unit, what counts as one; empty: margins stay in their unit, which must then be one.

    Raises
    ------
    ScenarioError
        Sides of a comparison, or terms of a sum, of other units; comparisons of several units without a scale.
    """
    results: set[str] = set()

    def scaled(kind: str, body: Any) -> tuple[str, Any]:
        if kind != "Predicate":
            return kind, body
        names = variables(body)
        if any(name not in units for name in names):
            return kind, body  # a condition
        unit = _same(_unit(body["lhs"], units), _unit(body["rhs"], units))
        if unit is None:
            return kind, body  # numbers only
        if not scale:
            results.add(unit)
            return kind, body
        if unit not in scale:
            raise ScenarioError(f"scale: no number for {unit or 'pure numbers'!r}; it has {', '.join(scale)}")
        share = {"Literal": scale[unit]}
        return kind, body | {side: {"Binary": ["Div", body[side], share]} for side in ("lhs", "rhs")}

    # Each comparison is scaled by itself, so that margins in several units can be compared.
    tree = _map(tree, scaled)
    if len(results) > 1:
        several = ", ".join(sorted(u or "1" for u in results))
        raise ScenarioError(
            f"its comparisons are in {several}, so they have no common margin; state what counts as one in "
            "each, scale: {unit: number}"
        )
    return tree, results.pop() if results else ""


def _unit(tree: Tree, units: Mapping[str, str]) -> str | None:
    """Return the unit of an expression; None for a plain number, which suits any."""
    kind, body = next(iter(tree.items()))
    if kind == "Variable":
        return text(powers(units[body]))
    if kind == "Literal":
        return None
    if kind == "Call":
        name, operands = body[0], [_unit(part, units) for part in body[1]]
        if name in ("abs", "floor", "ceil"):
            return operands[0]
        if name in ("min", "max"):
            return reduce(_same, operands)
        if name == "sqrt" and operands[0]:
            raise ScenarioError("sqrt of something with a unit: compare squares instead")
        return "" if operands[0] is not None else None
    name, left, right = body
    a, b = _unit(left, units), _unit(right, units)
    if name in ("Mul", "Div"):
        if a is None and b is None:
            return None
        first, second = powers(a or ""), powers(b or "")
        sign = 1 if name == "Mul" else -1
        total = {u: first.get(u, 0) + sign * second.get(u, 0) for u in (*first, *second)}
        return text({u: p for u, p in total.items() if p})
    if name == "Pow":
        n = right.get("Literal")
        # A unit has whole powers only.
        if a and (n is None or n != int(n)):
            raise ScenarioError(f"a power of something in {a} takes a whole number")
        return None if a is None else text({u: p * int(n or 0) for u, p in powers(a).items() if n})
    return _same(a, b)


def _same(a: str | None, b: str | None) -> str | None:
    if a is None or b is None:
        return b if a is None else a
    if powers(a) != powers(b):
        raise ScenarioError(f"{a or 'a pure number'!r} beside {b or 'a pure number'!r}")
    return a
