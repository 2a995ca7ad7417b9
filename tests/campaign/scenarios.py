"""Mutated scenario files: read, wired, checked and run for a few ticks, or refused in one line."""

import random
import re
from pathlib import Path

from softrig_bringup.plots.curves import check_plots
from softrig_core import (
    Recording,
    RunError,
    Scenario,
    ScenarioError,
    figures_of,
    list_scenarios,
    load_scenario,
    rig_of,
    run_inprocess,
)

JUNK = ("", "~", "0", "-1", "1e300", "-1e300", "1e-300", "1e-12", ".nan", ".inf", "1" * 5000, "9" * 400, "true", "[]",
        "{}", "[[]]", "{a: 1}", "x" * 5000, "'", '"', "$", "$plant", "$plant.x", "$a.b.c", "../../etc/passwd", "/etc",
        "a\x00b", "\u2028", "é", "&a [*a]", "*b", "!!python/object/apply:os.getcwd []", "!x y", "%", "- -", ": :",
        "1 +- 0", "1 +- -1", "at most", "at least x", "1e400 +- 1 %", "os.system", "{<<: {}}")  # fmt: skip


def mutated(text: str, chance: random.Random) -> str:
    """Change a value, a key, the order or the depth of lines, or single characters."""
    lines = text.split("\n")
    at = chance.randrange(len(lines))
    kind = chance.randrange(9)
    if kind <= 3:  # the value after a colon
        if not (places := list(re.finditer(r": *([^\n{},\[\]]+)", text))):
            return text  # an earlier mutation has removed the value
        place = chance.choice(places)
        return text[: place.start(1)] + chance.choice(JUNK) + text[place.end(1) :]
    if kind == 4:
        del lines[at : at + chance.choice((1, 1, 3, 10))]
    elif kind == 5:
        lines.insert(at, lines[chance.randrange(len(lines))])
    elif kind == 6:
        lines[at] = " " * chance.randrange(6) + lines[at]
    elif kind == 7:
        words = re.findall(r"\w+", text)
        return text.replace(chance.choice(words), chance.choice((*words, *JUNK)), 1)
    else:
        at = chance.randrange(len(text))
        return text[:at] + chance.choice("{}[]:,-#&*!|>'\"%@` \t\n\x00\ufeff") + text[at + chance.randrange(3) :]
    return "\n".join(lines)


def attack(seed: int, directory: Path) -> None:
    """Mutate one of the suite's files once to five times; use it as `run` would."""
    chance = random.Random(seed)
    paths = sorted(set(list_scenarios().values()))
    text = chance.choice(paths).read_text()
    for _ in range(chance.choice((1, 1, 2, 5))):
        text = mutated(text, chance)
    path = directory / "hostile.yaml"
    path.write_bytes(text.encode("utf-8", "replace"))
    before = sorted(directory.rglob("*"))
    try:
        use(path)
    except (ScenarioError, RunError) as error:
        if not str(error).strip():
            raise AssertionError("no reason given") from None
    assert sorted(directory.rglob("*")) == before, "files were written"


def use(path: Path) -> None:
    """Read, wire and check a scenario; run a few ticks of a quick one."""
    scenario: Scenario = load_scenario(str(path))
    rig = rig_of(scenario)
    figures_of(rig)
    check_plots(rig)
    if any(m.external for m in rig.members):
        return
    slowest = max(float(m.params.period) for m in rig.members)
    rig = rig_of(rig, duration=min(scenario.duration, 2 * slowest))
    if rig.ticks <= 500:
        recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
        run_inprocess(rig, scenario.seed, recording)
