"""The README is true: its commands exist; the controller of the tutorial closes a loop."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from softrig_bringup.cli import FORMER, main, make_parser
from softrig_core import list_scenarios
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import PROFILE, find_executable

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


@pytest.mark.long
@pytest.mark.processes
def test_the_controller_of_the_tutorial_replaces_ours(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "ros_pkgs/softrig_bringup/doc/own_controller.md").read_text()
    code = re.search(r"```python\n(.*?)```", page, re.S)
    (tmp_path / "my_controller.py").write_text(code.group(1))
    with free_domain() as domain:
        pass  # only find a free domain; `run --domain` reserves it itself
    environment = os.environ | {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(PROFILE),
        "ROS_LOG_DIR": str(tmp_path),
    }
    controller = subprocess.Popen([sys.executable, "my_controller.py"], env=environment)
    try:
        status = main(["run", "dc_motor_smc_b2", "--external", "dc_motor_smc", "--domain", str(domain)])
    finally:
        controller.kill()
        controller.wait()
    printed = capsys.readouterr()
    assert status == 0, printed.err  # figures of another controller are compared with softrig's, not judged
    assert "not judged" in printed.out
    # Each step left to the user has its own line.
    messages = [line.strip() for line in printed.err.splitlines()]
    assert any(line.startswith("dc_motor_smc must publish motor/command") for line in messages)
    assert len(list(tmp_path.glob("runs/dc_motor_smc_b2-external_dc_motor_smc/report.html"))) == 1


def test_every_command_of_the_readme_exists():
    verbs = set(make_parser()._subparsers._group_actions[0].choices)
    scenarios = set(list_scenarios())
    for verb, remaining in re.findall(r"scripts/softrig (\w+)([^#\n]*)", README):
        assert verb in verbs, verb
        if verb == "run":
            assert remaining.split()[0] in scenarios, remaining
        if verb == "node":
            assert find_executable(*remaining.split()[:2])
    for package, executable in re.findall(r"ros2 run (\w+) (\w+)", README):
        assert find_executable(package, executable)
    for path in [*re.findall(r"\]\((\S+?)\)", README), *re.findall(r'src="(.+?)"', README)]:
        assert path.startswith("http") or (ROOT / path).exists(), path


def test_every_package_is_described_and_depends_one_way():
    for manifest in ROOT.glob("ros_pkgs/*/package.xml"):
        text = manifest.read_text()
        name = manifest.parent.name
        used = set()
        for module in manifest.parent.glob(f"{name}/**/*.py"):
            used |= set(re.findall(r"^\s*(?:from|import) (softrig_\w+)", module.read_text(), re.M))
        declared = set(re.findall(r"<exec_depend>(softrig_\w+)</exec_depend>", text))
        assert used - {name} <= declared, f"{name} does not declare {used - {name} - declared}"
        allowed = {
            "softrig_core": set(),
            "softrig_nodes": {"softrig_core"},
            "softrig_control": {"softrig_core", "softrig_nodes"},
            "softrig_optim": {"softrig_core", "softrig_nodes"},
            "softrig_bags": {"softrig_core", "softrig_nodes"},
        }.get(name)
        assert allowed is None or declared <= allowed, name


def test_the_version_is_the_same_everywhere():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])
    result = re.findall(r"^## (\S+)(?: \((\d{4}-\d\d-\d\d)\))?$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert next(pair for pair in result if pair[1])[0] == project["version"]
    for manifest in ROOT.glob("ros_pkgs/*/package.xml"):  # test_workspace.py compares the manifests with setup.cfg
        assert f"<version>{project['version']}</version>" in manifest.read_text(), manifest


def test_the_upgrade_page_has_every_renamed_verb():
    page = (ROOT / "ros_pkgs/softrig_bringup/doc/upgrade.md").read_text()
    table = re.search(r"<!-- verbs -->\n(.*?)<!-- end -->", page, re.S)[1].replace("\\|", "|")
    rows = dict(re.findall(r"^\| `softrig (\w+)` \| `softrig (.+)` \|$", table, re.M))
    assert rows == FORMER
    verbs = set(make_parser()._subparsers._group_actions[0].choices)
    assert {new.split()[0] for new in rows.values()} <= verbs
    assert not verbs & rows.keys()


def test_links_of_the_page_for_contributors_are_valid():
    page = ROOT / ".github/CONTRIBUTING.md"
    for path in re.findall(r"\]\((\S+?)\)", page.read_text()):
        assert (page.parent / path).exists(), path
