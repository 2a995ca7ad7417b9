"""The first hour of three users: from outside the repository, in a path with a space, in 60 columns, without a
terminal and without root's power over files: change a gain, bring a package, set an own law beside the paper."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from conftest import PATIENCE
from softrig_bringup.cli import main
from softrig_bringup.verbs.new import new_package
from softrig_core import ScenarioError

UID = 54321  # no user has this number
SOFTRIG = Path(__file__).parents[2] / "scripts" / "softrig"

LAW = '''
"""A law of one's own for the motor of the paper."""

from softrig_core.block.block import Block
from softrig_core.block.params import BlockParams, param
from softrig_core.block.port import command, joint_state, reference


class Params(BlockParams):
    """One gain."""

    k: float = param(4.0, "gain", "V s/rad", ge=0.0, le=100.0)


class Law(Block[Params]):
    """u = k (w_ref - w)."""

    INPUTS = (
        joint_state("state", "motor/state", ["shaft"], velocity="rad/s"),
        reference("reference", "motor/reference", ["shaft"], velocity="rad/s"),
    )
    OUTPUTS = (command("command", "motor/command", ["armature"], "V"),)

    def update(self, x, t, state, reference):
        """Answer a tick."""
        return x, {"command": (self.p.k * (reference[0] - state[0]),)}

'''
BESIDE = """
title: My law beside the paper's
extends: dc_motor_smc_b2
nodes:
  dc_motor_smc: {package: heater, executable: motor_law, parameters: {period: 0.01}}
plots: # the paper's show its sliding surface
  - {title: Speed, signals: {motor/true_state/shaft/velocity: speed, motor/reference/shaft/velocity: reference}}
"""


class User:
    """A person at a prompt: another user with a separate home, nothing of ours set, no terminal, 60 columns."""

    def __init__(self, folder):
        self.folder = folder / "my work"
        self.folder.mkdir()
        home = folder / "home"
        home.mkdir()
        prefixes = ("AMENT_", "PYTHON", "VIRTUAL_ENV", "LD_PRELOAD", "COLCON_", "SOFTRIG_", "PYTEST_", "XDG_")
        keep = {k: v for k, v in os.environ.items() if not k.startswith(prefixes)}
        self.environment = keep | {"COLUMNS": "60", "HOME": str(home)}
        # A checkout with a space in its path has its environment in the cache of the user who made it.
        if " " in str(SOFTRIG):
            cache = os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache"))
            self.environment["XDG_CACHE_HOME"] = cache
        self.become = []
        if os.geteuid() == 0:  # otherwise the tests already run without root's privileges
            self.become = ["setpriv", "--bounding-set=-all", "--inh-caps=-all"]
            another = [f"--reuid={UID}", f"--regid={UID}", "--clear-groups"]
            again = "import subprocess, sys; sys.exit(subprocess.run([sys.executable, '-c', '']).returncode)"
            python = subprocess.run([*self.become, *another, sys.executable, "-c", again], capture_output=True)
            if not python.returncode:  # root's Python may lie in root's home, which other users cannot read
                self.become += another
                for place in (folder, home, self.folder):
                    os.chown(place, UID, UID)

    def __call__(self, command, status=0, timeout=PATIENCE):
        """Run a command; return what it printed and its errors."""
        done = subprocess.run([*self.become, "bash", "-c", command], cwd=self.folder, env=self.environment,
                              stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout)  # fmt: skip
        assert done.returncode == status, done.stdout + done.stderr
        return done.stdout, done.stderr


@pytest.fixture(scope="module")
def user():
    # Other users cannot enter pytest's temporary folders.
    with tempfile.TemporaryDirectory(prefix="softrig-first-hour-") as folder:
        yield User(Path(folder))


@pytest.fixture(scope="module")
def package(user):
    """The package that `softrig new` writes, with a controller of the user added; not built."""
    out, _ = user(f"'{SOFTRIG}' new heater")
    assert "--workspace heater run heater" in out
    folder = user.folder / "heater"
    (folder / "heater" / "motor_law.py").write_text(LAW)
    setup = folder / "setup.cfg"
    setup.write_text(
        setup.read_text().replace("    heater_plant =", "    motor_law = heater.motor_law:Law.main\n    heater_plant =")
    )
    return folder


def typed(command):
    """Exit status of a command, in this process."""
    try:
        return main(command.split())
    except SystemExit as ended:  # argparse exits this way
        return ended.code


def test_somebody_changes_a_gain(user, capsys, monkeypatch):
    out, _ = user(f"'{SOFTRIG}' run dc_motor_smc_b2 --mode inprocess --no-plots --set dc_motor_smc.delta=2")
    assert "changed: dc_motor_smc.delta=2" in " ".join(out.split())
    assert max(map(len, out.splitlines())) <= 60
    assert "…" not in out  # names and numbers are whole
    for name in ("settling_time", "peak_to_peak", "total_variation"):
        assert name in out
    content = json.loads((user.folder / "runs" / "dc_motor_smc_b2-dc_motor_smc.delta=2" / "metrics.json").read_text())
    assert content["changed"] == ["dc_motor_smc.delta=2"]
    monkeypatch.chdir(user.folder)
    for command, text in (
        ("run ./nothing.yaml", "nothing.yaml: no such file"),
        ("run dc_motor_smc_b2 --mode inprocess --set dc_motor_smc.detla=2", "did you mean 'delta'"),
        ("rnu dc_motor_smc_b2", "did you mean 'run'"),
        ("run dc_motor_smc_b2 --duratoin 3", "did you mean '--duration'"),
        ("run dc_motor_smc_b2 --external dc_motor_scm", "did you mean 'dc_motor_smc'"),
        ("node softrig_drive dc_motor_plant", "did you mean 'softrig_drives'"),
        ("node softrig_drives dc_motor_plnt", "did you mean 'dc_motor_plant'"),
        ("study dc_motor_smc_b2 --workers 0", "expected a whole number from 1 to 1000"),
    ):
        assert typed(command) == 2
        error = capsys.readouterr().err
        assert text in error
        assert error.count("\n") == 1


@pytest.mark.long
def test_a_place_that_cannot_be_written_is_one_line(user):
    (user.folder / "shut").mkdir(mode=0o555)
    _, error = user(f"'{SOFTRIG}' run dc_motor_smc_b2 --mode inprocess --out shut/here", status=2)
    assert error.count("\n") == 1
    assert "Permission denied" in error


@pytest.mark.long
@pytest.mark.processes
def test_the_package_runs_immediately_in_both_lockstep_modes(user, package):
    command = f"cd heater && '{SOFTRIG}' --workspace . run heater --no-plots --mode"
    figures = []
    for mode in ("inprocess", "processes"):
        user(f"{command} {mode} --out {mode}")
        content = json.loads((package / mode / "metrics.json").read_text())
        figures.append(content["metrics"])
        if mode == "inprocess":  # the printed command works in any folder
            out, _ = user(f"cd / && {content['command']} --no-plots")
            assert f"results in {package / mode}".replace(" /", " ") in " ".join(out.split())
    assert figures[0] == figures[1]
    assert all(f["pass"] for f in figures[0])


def heaters(user, command=f"'{SOFTRIG}'"):
    """Scenarios of the package, by file, where the environment of a command searches for them."""
    out, _ = user(f'eval "$({command} env)"; echo "$AMENT_PREFIX_PATH"')
    return {f.stem for prefix in out.strip().split(":") for f in Path(prefix).glob("share/heater/scenarios/*.yaml")}


@pytest.mark.long
def test_a_workspace_is_remembered_updated_and_forgotten(user, package):
    user(f"'{SOFTRIG}' --workspace heater list heater")
    assert "linear-quadratic" in user(f"'{SOFTRIG}' list heater")[0]
    (package / "scenarios" / "heater_more.yaml").write_text("extends: heater\nduration: 1.0\n")
    setup, old = package / "setup.cfg", (package / "setup.cfg").read_text()
    setup.write_text(old.replace("scenarios/heater.yaml", "scenarios/*.yaml"))
    assert heaters(user) == {"heater", "heater_more"}
    (package / "scenarios" / "heater_more.yaml").unlink()
    assert heaters(user) == {"heater"}
    setup.write_text(old)
    assert not heaters(user, f"SOFTRIG_WORKSPACE=none '{SOFTRIG}'")
    assert heaters(user) == {"heater"}
    assert not heaters(user, f"'{SOFTRIG}' --workspace none")
    assert not user(f"'{SOFTRIG}' list heater", 1)[0]
    for command in (f"'{SOFTRIG}' --workspace nowhere list", f"SOFTRIG_WORKSPACE=nowhere '{SOFTRIG}' list"):
        _, error = user(command, status=2)
        assert error.startswith("softrig: --workspace 'nowhere': no ROS package there")


@pytest.mark.long
def test_a_command_of_a_checkout_that_belongs_to_another_user(user):
    out, _ = user(f"""eval "$('{SOFTRIG}' env)" && softrig --version""")
    assert out.startswith("softrig ")


@pytest.mark.long
@pytest.mark.processes
def test_an_overlay_sourced_before_is_honoured(user, package):
    user(f"cd heater && '{SOFTRIG}' env colcon build --symlink-install")
    out, _ = user(f"""cd heater && eval "$('{SOFTRIG}' env)" && . install/local_setup.sh && cd .. &&
        softrig list heater && '{SOFTRIG}' run heater --mode inprocess --no-plots""")
    assert "An inverted pendulum under linear-quadratic control" in " ".join(out.split())


@pytest.mark.long
def test_a_run_of_a_users_package_is_repeated_elsewhere(user, package):
    command = f"'{SOFTRIG}' --workspace heater"
    user(f"{command} run heater --mode inprocess --no-plots --set heater_controller.r=0.1 --out mine")
    user(f"{command} pack mine --out sent.zip")
    user(f"'{SOFTRIG}' --workspace none list heater", 1)
    away = package.with_name("away")
    package.rename(away)
    try:
        # `--like` repeats the run in processes, after somebody has confirmed that the code in the pack may run.
        again = f"'{SOFTRIG}' run --like sent.zip --no-plots --out again"
        _, text = user(again, status=2)
        assert "its code runs only when somebody confirms it" in text
        _, text = user(f"{again} --trust")
        assert "repeats sent.zip number for number: 1001 messages on 2 topics" in text.splitlines()[-1]
        _, text = user(f"'{SOFTRIG}' run --like mine --no-plots", status=2)
        assert "it needs package heater, not installed here" in text
    finally:
        away.rename(package)


@pytest.mark.long
@pytest.mark.processes
def test_a_users_law_is_compared_with_the_papers(user, package):
    (user.folder / "beside.yaml").write_text(BESIDE)
    run = f"'{SOFTRIG}' --workspace heater run"
    user(f"{run} beside.yaml --mode inprocess --no-plots && {run} dc_motor_smc_b2 --mode inprocess --no-plots")
    user(f"'{SOFTRIG}' report runs/beside runs/dc_motor_smc_b2 --out both.html")
    page = (user.folder / "both.html").read_text()
    assert "side by side" in page
    assert "My law beside the paper" in page


FAILS = ("self.p.k", "1 / 0", LAW[: LAW.index("return")].count("\n") + 1)
ABSENT = ('"""A law', 'import nothing_such\n"""A law', 2)
NO_PYTHON = ('"""A law', 'def (\n"""A law', 2)


@pytest.mark.processes
@pytest.mark.parametrize(
    ("mistake", "mode", "status", "text"),
    [
        (FAILS, "inprocess", 3, "ZeroDivisionError: division by zero"),
        pytest.param(FAILS, "processes", 3, "ZeroDivisionError: division by zero", marks=pytest.mark.long),
        pytest.param(
            ABSENT, "inprocess", 2, "ModuleNotFoundError: No module named 'nothing_such'", marks=pytest.mark.long
        ),
        pytest.param(NO_PYTHON, "inprocess", 2, "SyntaxError: invalid syntax", marks=pytest.mark.long),
    ],
)
def test_an_error_in_users_code_names_file_and_line(user, package, mistake, mode, status, text):
    (user.folder / "beside.yaml").write_text(BESIDE)
    file = package / "heater" / "motor_law.py"
    right, wrong, line = mistake
    file.write_text(LAW.replace(right, wrong))
    try:
        _, error = user(f"'{SOFTRIG}' --workspace heater run beside.yaml --mode {mode} --no-plots --out {mode}", status)
        errors = [error]
        if status == 2:  # a single node prints the same error
            assert "the traceback is in" in error
            errors.append(user(f"'{SOFTRIG}' --workspace heater node heater motor_law", 2)[1])
        for error in errors:
            assert text in error
            assert f"heater/motor_law.py, line {line})" in error
    finally:
        file.write_text(LAW)


@pytest.mark.long
def test_the_package_runs_in_real_time_and_passes_its_own_tests(user, package):
    user(f"cd heater && '{SOFTRIG}' --workspace . run heater --realtime")
    out, _ = user(f"""cd heater && '{SOFTRIG}' env colcon test && '{SOFTRIG}' env colcon test-result""")
    assert "3 tests, 0 errors, 0 failures, 0 skipped" in out


@pytest.mark.parametrize(
    ("name", "message"),
    [(n, "package name") for n in ("Heater", "2heater", "heat-er", "heat__er", "numpy", "json", "class", "..", "")]
    + [(n, rf"`run {n}` is a scenario already \(dc_motor_smc") for n in ("dc_motor_smc", "dc_motor_smc_b2_delta1")],
)
def test_a_name_that_cannot_be_a_package_or_is_that_of_a_scenario_is_refused(tmp_path, name, message):
    with pytest.raises(ScenarioError, match=message):
        new_package(name, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.long
@pytest.mark.parametrize("kind", ["law", "plant"])
def test_a_law_or_a_plant_alone_runs_as_it_is_written(user, kind):
    name = f"alone_{kind}"
    assert f"--workspace {name} run {name}" in user(f"'{SOFTRIG}' new {name} --only {kind}")[0]
    user(f"'{SOFTRIG}' --workspace {name} run {name} --mode inprocess --no-plots --strict")
    out, _ = user(f"'{SOFTRIG}' --workspace {name} python -m pytest -q {name}/test")
    assert "passed" in out
    assert "failed" not in out


def test_no_file_is_overwritten(tmp_path, capsys):
    (tmp_path / "heater").mkdir()
    assert main(["new", "heater", "--into", str(tmp_path)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert not list((tmp_path / "heater").iterdir())


def test_help_names_every_verb(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    out = capsys.readouterr().out
    for verb in ("env", "setup", "python", "new", "bag", "--workspace"):
        assert verb in out
