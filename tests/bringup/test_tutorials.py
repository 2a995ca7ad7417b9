"""The tutorials are true: the files and commands that a reader types work, in order, and print what the page shows."""

import os
import re
import shlex
import shutil
import signal
import subprocess
from contextlib import suppress
from typing import NamedTuple

import pytest
from docs.outline import KINDS, ROOT, pages
from softrig_bringup.cli import FOREIGN, SCRIPT, make_parser
from softrig_bringup.page.wording import accepted
from softrig_core import list_scenarios, load_scenario, simulate
from softrig_core.board.simavr import HEADER
from softrig_core.firmware.check import CORE, DEBIAN
from softrig_nodes.processes.domain import free_domain

GUIDES = (
    "bags_pandas",
    "linear_view",
    "own_robot",
    "paper_figures",
    "reports",
    "send",
    "studies",
    "upgrade",
)  # tutorials whose steps depend on each other
TUTORIALS = (*KINDS["tutorials"][2], *GUIDES)
_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$|(?<=\n\n)((?:    [^\n]*\n)+)", re.S | re.M)
_COMMAND = re.compile(r"((?:scripts/)?softrig|ls|sed|export|cd|kill|python)\b")
MARK = "@@ block"


class Block(NamedTuple):
    """A part of a page: a file to write, commands to type, or their output."""

    kind: str
    text: str


def blocks(page: str) -> list[Block]:
    result = []
    for match in _BLOCK.finditer(page):
        language, fenced, indented = match.groups()
        if indented:
            text = re.sub(r"^    ", "", indented, flags=re.M)
            text = text.replace("scripts/softrig ", "softrig ")
            if _COMMAND.match(text) and not page[: match.start()].rstrip().endswith("<!-- runs until Ctrl-C -->"):
                result.append(Block("commands", text))
        elif language == "text":
            result.append(Block("output", fenced))
        elif re.match(r"(?:# [\w/]+\.\w+|/\* \w+\.\w+ \*/)\n", fenced):
            result.append(Block("file", fenced))
        elif language == "python":
            result.append(Block("commands", f"softrig python - <<'@@ end'\n{fenced.rstrip()}\n@@ end\n"))
    return result


def script(result: list[Block]) -> str:
    # Otherwise background processes would outlive the test.
    lines = ["set -eo pipefail", "trap 'jobs -p | xargs -r kill' EXIT"]
    lines += [f"cd {shlex.quote(str(ROOT))}", 'eval "$(scripts/softrig env)"', 'cd "$FOLDER"']
    for number, block in enumerate(result):
        if block.kind == "file":
            first, _, remaining = block.text.partition("\n")
            name = re.search(r"[\w/]+\.\w+", first)[0]
            # The line with the file name is no XML comment.
            text = remaining if name.endswith(".urdf") else block.text
            lines += [f"cat > {name} <<'@@ end'", text.rstrip("\n"), "@@ end"]
        elif block.kind == "commands":
            lines += [f"echo '{MARK} {number}'", block.text.rstrip("\n")]
    return "\n".join([*lines, f"echo '{MARK} end'", ""])


def shown(expected: str, printed: str) -> str:
    """Return the line of an example that was not printed, in order; `...` stands for anything."""
    lines = iter([" ".join(line.split()) for line in printed.splitlines()])
    for line in filter(None, (" ".join(e.split()) for e in expected.splitlines())):
        pattern = ".*".join(map(re.escape, line.split("...")))
        if not any(re.fullmatch(pattern, one) for one in lines):
            return line
    return ""


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", TUTORIALS)
def test_a_tutorial_does_what_it_describes(name, tmp_path):
    if name == "board_tutorial" and not (shutil.which("avr-gcc") and CORE.is_dir() and HEADER.is_file()):
        pytest.skip(f"needs an AVR compiler and simavr (Debian: {DEBIAN})")
    result = blocks(pages()[name].read_text())
    assert sum(block.kind == "commands" for block in result) >= 2
    with free_domain() as domain:
        pass  # only find a free domain; `run --domain` reserves it itself
    work = tmp_path / "work"
    work.mkdir()
    text = script(result).replace("ROS_DOMAIN_ID=42", f"ROS_DOMAIN_ID={domain}")
    text = text.replace("--domain 42", f"--domain {domain}")
    environment = os.environ | {
        "FOLDER": str(work),
        "XDG_STATE_HOME": str(tmp_path / "state"),
        "ROS_LOG_DIR": str(tmp_path / "log"),
        "COLUMNS": "300",  # the pages show unwrapped lines, however many digits a time has
    }
    environment.pop("SOFTRIG_WORKSPACE", None)
    done = subprocess.Popen(["bash", "-c", text], env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                            text=True, start_new_session=True)  # fmt: skip
    try:
        printed = done.communicate(timeout=800)[0]
    finally:
        with suppress(ProcessLookupError):
            os.killpg(done.pid, signal.SIGKILL)  # also ends a controller in the background
    assert done.returncode == 0, printed
    parts = dict(re.findall(rf"^{MARK} (\w+)\n(.*?)(?=^{MARK}|\Z)", printed, re.S | re.M))
    assert "end" in parts, printed
    last = ""
    for number, block in enumerate(result):
        if block.kind == "commands":
            last = parts[str(number)]
        elif block.kind == "output":
            assert not (line := shown(block.text, last)), f"{line}\nwas not printed:\n{last}"


@pytest.mark.parametrize("name", TUTORIALS)
def test_the_commands_of_a_tutorial_are_commands(name):
    verbs = make_parser()
    known = set(verbs._subparsers._group_actions[0].choices)
    for block in blocks(pages()[name].read_text()):
        if block.kind == "commands" and "<<" not in block.text:
            for line in re.sub(r"\\\n", " ", block.text).splitlines():
                words = shlex.split(re.split(r" (?:\|\||&|2?>|#)", line)[0], comments=True)
                if words[0] != "softrig" or words[1] == "--version":
                    continue
                words = words[3:] if words[1] == "--workspace" else words[1:]
                assert words[0] in known, line
                if words[0] not in {*FOREIGN, *SCRIPT}:
                    verbs.parse_args(words)


def test_a_table_of_a_tutorial_has_the_expectations_of_the_scenario():
    """The run itself takes too long to be tried each day."""
    held = set()
    for name in TUTORIALS:
        scenario = None
        for block in blocks(pages()[name].read_text()):
            if block.kind == "commands" and (
                result := re.findall(r"^softrig (?:--workspace \S+ )?run (\S+)", block.text, re.M)
            ):
                scenario = result[-1] if result[-1] in list_scenarios() else None
            if block.kind != "output" or scenario is None:
                continue
            for line in block.text.splitlines():
                figure, *cells = re.split(" {2,}", line)
                asked = [cell for cell in cells if re.search("[±≤≥]", cell)]
                if asked and (limits := load_scenario(scenario).expect.get(figure)):
                    assert asked == [accepted(limits)], f"{name}: {line}"
                    held.add(name)
    assert held >= {"first_run", "own_controller"}


def test_the_output_of_an_example_is_compared_with_what_was_printed():
    assert shown("a  1 s\nb ... s\n", "x\na 1 s  \ny\nb 0.3 s\n") == ""
    assert shown("a 1 s\n", "a 2 s\n") == "a 1 s"
    assert shown("b\na\n", "a\nb\n") == "a"  # lines must occur in the same order
    assert blocks("Do:\n\n    softrig list\n\n```text\nx\n```\n```yaml\n# a.yaml\nb: 1\n```\n\n    always x > 1\n") == [
        ("commands", "softrig list\n"),
        ("output", "x\n"),
        ("file", "# a.yaml\nb: 1\n"),
    ]


def test_rounded_gains_settle_late():
    gains = {"dc_motor_pid.kp": 8.3, "dc_motor_pid.ki": 1.64, "dc_motor_pid.kd": 0.59}
    result = simulate("dc_motor_smc_b4", overrides=gains).figures
    assert result["settling_time"] == pytest.approx(0.835623, rel=1e-5)
    assert result["overshoot"] == pytest.approx(2.45958, rel=1e-5)
