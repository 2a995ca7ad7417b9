"""The Dockerfile, the devcontainer and the workflow: read as their tools do, and their commands run in a fresh folder.

What needs an image (apt-get, useradd) is read only: there is no registry of images here.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import yaml
from softrig_bringup.cli import make_parser
from softrig_core import list_scenarios

ROOT = Path(__file__).parents[2]
DOCKERFILE = ROOT / ".devcontainer" / "Dockerfile"
DEVCONTAINER = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text())
# BaseLoader, because YAML reads the key `on` as true
WORKFLOW = yaml.load((ROOT / ".github" / "workflows" / "rigs.yml").read_text(), yaml.BaseLoader)
SET_UP = ("setup",)  # verbs of scripts/softrig itself
OF_THE_IMAGE = ("apt-get", "useradd")


def instructions():
    """Keyword and rest of each line of the Dockerfile."""
    text = re.sub(r"^#.*\n", "", DOCKERFILE.read_text(), flags=re.M).replace("\\\n", " ")
    return [tuple(line.split(None, 1)) for line in text.splitlines() if line]


def commands(job):
    return [step["run"] for step in WORKFLOW["jobs"][job]["steps"] if "run" in step]


def test_the_dockerfile_copies_existing_files_and_sets_up_as_the_user_that_runs():
    result = instructions()
    assert {word for word, _ in result} == {"FROM", "RUN", "USER", "WORKDIR", "COPY", "ENTRYPOINT", "CMD"}
    stages = [remaining.split() for word, remaining in result if word == "FROM"]
    assert [s[0] for s in stages] == ["debian:trixie-slim", "base"]
    assert stages[0][1:] == ["AS", DEVCONTAINER["build"]["target"]]
    user = next(remaining for word, remaining in result if word == "USER")
    assert user == DEVCONTAINER["remoteUser"]
    assert any(remaining.startswith("useradd") and remaining.split()[-1] == user for _, remaining in result)
    (copied,) = [remaining for word, remaining in result if word == "COPY"]
    assert copied == f"--chown={user} . softrig"
    entry = json.loads(next(remaining for word, remaining in result if word == "ENTRYPOINT"))
    assert (ROOT / entry[0].removeprefix("softrig/")).is_file()
    left_out = DOCKERFILE.with_name("Dockerfile.dockerignore").read_text().split()
    assert set(left_out) == {".venv", ".ws", "runs", "**/__pycache__"}


def test_the_devcontainer_builds_from_the_checkout():
    folder = ROOT / ".devcontainer"
    assert (folder / DEVCONTAINER["build"]["dockerfile"]) == DOCKERFILE
    assert (folder / DEVCONTAINER["build"]["context"]).resolve() == ROOT
    assert (ROOT / "scripts" / "locks" / f"{shlex.split(DEVCONTAINER['postCreateCommand'])[-1]}.lock").is_file()


def all_commands():
    of_docker = [
        remaining for word, remaining in instructions() if word == "RUN" and not remaining.startswith(OF_THE_IMAGE)
    ]
    return (
        [c.removeprefix("softrig/") for c in of_docker]
        + [DEVCONTAINER["postCreateCommand"]]
        + [c for job in WORKFLOW["jobs"] for c in commands(job)]
    )


@pytest.mark.parametrize("command", all_commands())
def test_every_command_is_one_that_softrig_knows(command):
    script, *words = shlex.split(command.removeprefix("mkdir -p runs && "))
    assert os.access(ROOT / script, os.X_OK)
    if script == "scripts/test" or words[0] in SET_UP:
        return
    options = make_parser().parse_args(words)  # the parser exits if an option is unknown
    named = getattr(options, "scenarios" if words[0] == "check" else "scenario")
    assert ({named} if isinstance(named, str) else set(named)) <= set(list_scenarios())


def test_the_workflow_keeps_files_that_its_commands_write():
    steps = [step for job in WORKFLOW["jobs"].values() for step in job["steps"]]
    assert all(("uses" in step) != ("run" in step) for step in steps)
    (kept,) = [step["with"]["path"] for step in steps if step.get("uses", "").startswith("actions/upload-artifact@")]
    written = [w for c in commands("rigs") for w in re.findall(r"--(?:junit|json|out) (\S+)", c)]
    assert written
    assert all(Path(name).parts[0] == kept for name in written)
    (cached,) = [step["with"] for step in steps if step.get("uses", "").startswith("actions/cache@")]
    assert cached["path"] == ".venv"
    assert list(ROOT.glob(re.search(r"hashFiles\('(.+)'\)", cached["key"])[1]))


@pytest.mark.long
def test_their_commands_work_in_a_fresh_folder_in_order(tmp_path):
    """As in the image and on the runner: a separate home, no ROS, no environment of ours; all but the test suite
    itself.
    """
    checkout = tmp_path / "softrig"
    ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for name in ("scripts", "ros_pkgs", "config", "bags"):
        shutil.copytree(ROOT / name, checkout / name, ignore=ignored)
    prefixes = ("AMENT_", "PYTHON", "VIRTUAL_ENV", "COLCON_", "SOFTRIG_", "LD_", "_ROS_", "ROS_", "PYTEST_")
    user = {k: v for k, v in os.environ.items() if not k.startswith(prefixes)}
    user |= {"HOME": str(tmp_path), "PATH": f"{sys.base_prefix}/bin:/usr/bin:/bin"}

    def run(command, folder):
        done = subprocess.run(
            ["bash", "-ec", command], cwd=folder, env=user, capture_output=True, text=True, stdin=subprocess.DEVNULL
        )
        assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
        return done.stdout

    of_docker = [
        remaining for word, remaining in instructions() if word == "RUN" and not remaining.startswith(OF_THE_IMAGE)
    ]
    for command in of_docker:
        run(command.replace("/tmp/", f"{tmp_path}/"), tmp_path)
    entry, arguments = (json.loads(next(r for w, r in instructions() if w == word)) for word in ("ENTRYPOINT", "CMD"))
    assert "dc_motor_smc_b2" in run(shlex.join(entry + arguments), tmp_path)
    for command in commands("rigs"):
        run(command, checkout)
    for name in ("check", "run", "golden"):
        report = ET.parse(checkout / "runs" / f"{name}.xml").getroot()
        assert int(report.attrib["tests"]) > 0
        assert report.attrib["failures"] == report.attrib["errors"] == "0"
    assert [b["pass"] for b in json.loads((checkout / "runs" / "golden.json").read_text())] == [True]
    assert (checkout / "runs" / "dc_motor_smc_b2" / "report.html").is_file()
    run(DEVCONTAINER["postCreateCommand"], checkout)
