"""Regression on golden bags: run the rig again, and feed each node the golden inputs in open loop."""

import hashlib
import inspect
import json
import math
import os
import re
import resource
import shutil
import struct
import subprocess
import sys
import xml.etree.ElementTree as ET
from argparse import Namespace
from functools import lru_cache
from pathlib import Path

import pytest
from conftest import few, replay
from softrig_bags.compare import compare
from softrig_bags.read import read_bag
from softrig_bags.write import write_bag
from softrig_bringup.run.run import versions
from softrig_bringup.verbs.golden import check, create, line, load, main
from softrig_core import Recording, RunError, ScenarioError, Signals, bits, feed, load_scenario, rig_of
from softrig_nodes import run_processes
from softrig_nodes.processes.spawning import node_parameters

BAGS = Path(__file__).parents[2] / "bags"
GOLDEN = sorted(p.parent.name for p in BAGS.glob("*/golden.yaml"))
THROUGH_PROCESSES = ("dc_motor_smc_b1", "dc_motor_smc_b4", "dc_motor_fsfb", "pv_mppt")  # fmt: skip


@pytest.fixture(autouse=True)
def kept(monkeypatch):
    """Return a golden bag, read once for all of its nodes."""
    monkeypatch.setattr(
        "softrig_bringup.verbs.golden.read_bag", lambda bag: read_golden(bag) if BAGS in bag.parents else read_bag(bag)
    )


read_golden = lru_cache(1)(read_bag)


def nodes():
    """Every node of every bag; daily only the smallest bag for each executable: the rerun judges the others again.

    So are two solvers whose answers take seconds.
    """
    seen = {("softrig_power", "dispatch_solver"), ("softrig_systems", "mvim_planner")}
    for name in sorted(GOLDEN, key=lambda name: sum(f.stat().st_size for f in (BAGS / name / "bag").glob("*"))):
        scenario = re.search(r"^scenario: (\w+)$", (BAGS / name / "golden.yaml").read_text(), re.M).group(1)
        for node, entry in load_scenario(scenario).nodes.items():
            daily = (entry.package, entry.executable) not in seen
            seen.add((entry.package, entry.executable))
            yield pytest.param(name, node, marks=() if daily else pytest.mark.long)


DEAR = "optimal_control_mvim"  # tests/systems runs its 20 s daily, so a shorter run is compared here


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.long] * (n == DEAR)) for n in GOLDEN])
def test_a_new_run_agrees_with_the_golden_bag(name):
    golden = load(BAGS / name)
    result = golden.compare(golden.rerun())
    assert result.equal, str(result)


def open_loop(golden, node):
    """Feed one node with the golden inputs and compare its answers on the topics of the bag."""
    recording = golden.recording()
    answers = feed(next(m for m in golden.rig.members if m.name == node), golden.recipe.seed, recording)
    shared = [topic for topic in answers.topics if topic in recording.topics]
    assert shared or not answers.topics
    return golden.compare(answers, shared, old=recording)


@pytest.mark.parametrize(("name", "node"), nodes())
def test_each_node_publishes_the_same_for_the_golden_inputs(name, node):
    result = open_loop(load(BAGS / name), node)
    assert result.equal, str(result)


@pytest.mark.parametrize(
    "name",
    [
        "dc_motor_smc_b1",
        "dc_motor_fsfb_stretch_jitter",
        "induction_dtc_short",
        *(
            pytest.param(n, marks=pytest.mark.long)
            for n in ("dc_motor_fsfb_s2", "pv_mppt", "manipulator_adsmc_s5", "rehab_impedance_r2")
        ),
    ],
)
def test_another_build_agrees_within_the_tolerances_of_the_bag(name):
    """Parameters of the plants changed by a few units in the last place stand for another C library."""
    golden = load(BAGS / name)
    shaken = golden.shaken(2.0)
    result = golden.compare(shaken, elsewhere=True)
    assert result.equal, str(result)
    if golden.recipe.elsewhere:
        # a wider deviation is detected, so the tolerances are not too wide
        assert not golden.compare(shaken, elsewhere=False).equal


def test_the_same_versions_demand_the_same_bytes(tmp_path, monkeypatch):
    golden = create(tmp_path / "dc_motor_smc_b1", "dc_motor_smc_b1", 0.1)
    golden.make()
    golden = load(golden.folder)
    assert golden.recipe.seed == 0
    one = golden.rerun()
    topic = one.topics["motor/command"]
    topic.data[5] = topic.data[5][:-8] + struct.pack(
        "<d", math.nextafter(struct.unpack("<d", topic.data[5][-8:])[0], 9.0)
    )
    assert golden.how == "byte for byte"
    assert not golden.compare(one).equal
    assert golden.compare(one, elsewhere=True).equal  # the bags agree within 1e-9
    recipe = golden.recipe.model_copy(update={"made_with": golden.recipe.made_with | {"math": "0"}})
    other = type(golden)(golden.folder, recipe, golden.rig)
    assert other.compare(one).equal
    assert other.how == f"within tolerances: math 0 there, {versions()['math']} here"
    assert other.check()[1] == f"byte for byte, with math 0 there, {versions()['math']} here"
    monkeypatch.setattr(type(golden), "rerun", lambda _: one)
    result, how = other.check()
    assert (result.equal, how) == (True, other.how)


def test_other_versions_use_the_tolerances_for_other_machines():
    golden = load(BAGS / "induction_dtc_short")
    # As if the installed versions had made the bag.
    recipe = golden.recipe.model_copy(update={"made_with": versions()})
    golden = type(golden)(golden.folder, recipe, golden.rig)
    assert not golden.others
    assert golden.recipe.elsewhere
    moved = golden.recipe.model_copy(update={"made_with": golden.recipe.made_with | {"numpy": "1.0"}})
    other = type(golden)(golden.folder, moved, golden.rig)
    assert other.others
    assert other.how == f"within tolerances: numpy 1.0 there, {versions()['numpy']} here"
    assert other.compare(golden.shaken(2.0)).equal
    python = golden.recipe.model_copy(update={"made_with": golden.recipe.made_with | {"python": "3.10.0"}})
    assert not type(golden)(golden.folder, python, golden.rig).others


@pytest.mark.parametrize(
    ("recorded_with", "same"), [("3.10.0", False), ("3.12.1", True), ("3.13.9", True), ("3.14.0", False)]
)
def test_another_version_of_python_requires_tolerances_for_blocks_that_are_not_ours(monkeypatch, recorded_with, same):
    """`sum` changed in 3.12 and 3.14; our own blocks do not use it."""
    golden = load(BAGS / "dc_motor_smc_b1")
    now = versions() | {"python": "3.13.0"}
    monkeypatch.setattr("softrig_bringup.verbs.golden.versions", lambda: now)
    recipe = golden.recipe.model_copy(update={"made_with": now | {"python": recorded_with}})
    golden = type(golden)(golden.folder, recipe, golden.rig)
    assert not golden.others
    member = golden.rig.members[-1]
    own = type("Own", (member.block_class,), {"__module__": "my_laws.law"})
    monkeypatch.setattr(member, "block_class", own)
    assert golden.others == ({} if same else {"python": (recorded_with, "3.13.0")})


def test_each_line_of_the_page_is_one_that_a_check_prints():
    text = (BAGS.parent / "ros_pkgs/softrig_core/doc/bits.md").read_text()
    messages = {line({*differ}) for differ in ((), ("python",), ("numpy",), ("math", "numpy"), ("machine", "math"))}
    assert len(messages) == 5
    assert set(re.findall(r"^\| \*(.*?)\*", text, re.M)) == messages


def digest(folder):
    """Hash of what a rig records, as one number."""
    result = hashlib.sha256()
    for t, topic, data in load(folder).rerun().messages():
        result.update(b"%d %b " % (t, topic.name.encode()) + data)
    return result.hexdigest()


DIGESTS = f"""
import hashlib, json, sys
from pathlib import Path
from softrig_bringup.verbs.golden import load
{inspect.getsource(digest)}
print(json.dumps([digest(Path(folder)) for folder in sys.argv[1:]]))
"""
KERNELS = {  # kernels that OpenBLAS and numpy choose on other CPUs; `pin` leaves variables that are set
    "prescott": {bits.CORE: "Prescott", bits.SIMD: bits.PINS[bits.SIMD]},
    "v2": {"NPY_ENABLE_CPU_FEATURES": "X86_V2"},
    "nehalem": {bits.CORE: "Nehalem"},
    "sandybridge": {bits.CORE: "Sandybridge"},
    "two threads": {"OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2"},
    "prescott and v2": {bits.CORE: "Prescott", "NPY_ENABLE_CPU_FEATURES": "X86_V2"},
    "skylakex": {bits.CORE: "SkylakeX", bits.SIMD: bits.PINS[bits.SIMD]},
    # A script that imports numpy before softrig, on a CPU with AVX-512.
    "unpinned": {bits.CORE: "SkylakeX", bits.SIMD: "AVX512_SPR"},
}


def digests(names, kernels):
    """Hashes of the recordings of the rigs under other kernels."""
    pins = {*bits.PINS, "NPY_ENABLE_CPU_FEATURES"}
    variables = {key: value for key, value in os.environ.items() if key not in pins} | kernels
    command = [sys.executable, "-X", "faulthandler", "-c", DIGESTS, *(str(BAGS / name) for name in names)]
    done = subprocess.run(command, env=variables, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


DIFFERED = ["fault_location_m4k", "gupfc_s2_short", "pwa_delay_p3", "dc_motor_fsfb_s7"]  # fmt: skip


@pytest.mark.long
def test_no_kernel_of_openblas_or_numpy_affects_a_bit():
    """Rigs that differed when their results depended on BLAS, LAPACK and numpy's array functions."""
    assert digests(DIFFERED, KERNELS["prescott and v2"]) == [digest(BAGS / name) for name in DIFFERED]


# These checks call BLAS. With the kernels of SkylakeX the process ends there if the CPU has no AVX-512.
CHECKED = {"optimal_control_mvim_s3_n2", "rehab_impedance", "rehab_impedance_r5"}


@pytest.mark.long
@pytest.mark.parametrize("kernels", KERNELS)
def test_no_kernel_affects_a_bit_of_any_golden_rig(kernels):
    wide = bits.cpu_has_avx512()
    if kernels == "unpinned" and not wide:
        pytest.skip("this CPU has no other kernels than the pinned ones")
    names = [n for n in GOLDEN if wide or kernels != "skylakex" or n not in CHECKED]
    assert digests(names, KERNELS[kernels]) == digests(names, {})


def test_the_bags_stay_small():
    sizes = {
        p.parent.name: sum(f.stat().st_size for f in (p.parent / "bag").glob("*")) for p in BAGS.glob("*/golden.yaml")
    }
    assert max(sizes.values()) < 0.5e6, max(sizes, key=sizes.get)
    assert sum(sizes.values()) < 20e6


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.parametrize("name", THROUGH_PROCESSES)
def test_a_new_run_through_processes_agrees_with_the_golden_bag(name, tmp_path):
    golden = load(BAGS / name)
    outcome = run_processes(golden.rig, golden.recipe.seed, tmp_path)
    assert outcome.error == ""
    result = golden.compare(outcome.recording)
    assert result.equal, str(result)


@pytest.mark.processes
@pytest.mark.parametrize(
    ("name", "node"),
    few(
        [
            ("dc_motor_smc_b1", "dc_motor_smc"),
            ("dc_motor_smc_b4", "dc_motor_pid"),
            ("dc_motor_smc_b1", "dc_motor_plant"),
        ],
        1,
    ),
)
def test_a_replay_in_lockstep_into_one_real_node_agrees(name, node, tmp_path):
    golden = load(BAGS / name)
    member = next(m for m in golden.rig.members if m.name == node)
    parameters = node_parameters(golden.rig, member, golden.recipe.seed, "lockstep")
    del parameters["run.links"]  # as a user starts a node: without a runner and without known peers
    if "reference" in member.links:
        parameters["run.paired"] = ["reference"]
    file = tmp_path / "parameters.yaml"
    lines = [f"    {key}: {json.dumps(value)}" for key, value in parameters.items()]
    file.write_text("/**:\n  ros__parameters:\n" + "\n".join(lines) + "\n")
    topics = [p.topic for p in member.outputs]
    read = [p.topic for p in member.inputs if p.name in member.links]
    started = (member.package, member.executable, "--ros-args", "-r", f"__node:={node}", "--params-file", file)
    status, printed = replay(tmp_path, golden.bag, topics, started, "--topics", *read)
    assert status == 0, printed
    result = golden.compare(read_bag(tmp_path / "answers"), topics)
    assert result.equal, str(result)


@pytest.mark.parametrize(
    ("name", "node", "parameter"),
    [
        ("dc_motor_smc_b1", "dc_motor_smc", "k_per_ref"),
        ("dc_motor_smc_b2", "dc_motor_smc", "c"),
        ("dc_motor_smc_b4", "dc_motor_pid", "kp"),
        ("dc_motor_smc_b1", "dc_motor_plant", "Kt"),
    ],
)
def test_one_per_cent_of_a_gain_fails_both_regression_tests(name, node, parameter):
    golden = load(BAGS / name)
    value = getattr(next(m for m in golden.rig.members if m.name == node).params, parameter)
    scenario = load_scenario(golden.recipe.scenario, {f"{node}.{parameter}": 1.01 * value})
    rig = rig_of(scenario.model_copy(update={"duration": golden.recipe.duration}))
    changed = type(golden)(golden.folder, golden.recipe, rig)
    assert not changed.compare(changed.rerun()).equal
    assert not open_loop(changed, node).equal


def remade(names, folder, **options):
    without = {"duration": None, "seed": None, "node": None, "differing": False}
    return main(Namespace(names=names, bags=folder, **without | options))


def checked(folder, **options):
    without = {"junit": None, "json": None, "node": None, "workers": 1}
    return check(Namespace(scenarios=[], bags=folder, **without | options))


def test_recording_a_bag_again_shows_the_difference_and_check_reports_it(tmp_path, capsys):
    create(tmp_path / "dc_motor_smc_b2", "dc_motor_smc_b2", 0.2, 0).make()
    assert checked(tmp_path) == 0
    assert "kB, agrees byte for byte\n" in capsys.readouterr().out
    recipe = tmp_path / "dc_motor_smc_b2" / "golden.yaml"
    recipe.write_text(recipe.read_text().replace("scenario: dc_motor_smc_b2", "scenario: dc_motor_smc_b2_delta2"))
    assert checked(tmp_path) == 1
    assert "motor/command" in capsys.readouterr().out
    assert remade([], tmp_path, differing=True) == 0
    assert "DIFFERS" in capsys.readouterr().out
    written = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()}
    assert remade([], tmp_path, differing=True) == 0
    assert "agrees" in capsys.readouterr().out
    assert {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()} == written


def test_topics_that_a_rig_publishes_since_are_not_compared(tmp_path, capsys):
    """A plant with one more output changes no bag; a missing topic is a difference."""
    golden = create(tmp_path / "dc_motor_smc_b2", "dc_motor_smc_b2", 0.1)
    whole = golden.rerun()

    def without(*names):
        held = [t for t in whole.topics.values() if t.name not in names]
        fewer = Recording((t.name, t.msgtype) for t in held)
        for t, topic, data in whole.messages():
            if topic in held:
                fewer.add(held.index(topic), t, data)
        return fewer

    golden.make()
    shutil.rmtree(golden.bag)
    write_bag(golden.bag, without("motor/surface"))
    assert checked(tmp_path) == 0
    assert "agrees byte for byte; not in the bag: motor/surface\n" in capsys.readouterr().out
    assert open_loop(load(golden.folder), "dc_motor_smc").equal
    assert golden.compare(without("motor/surface")).equal
    assert not golden.compare(without("motor/command")).equal


def test_bags_are_selected_by_a_node(tmp_path, capsys):
    """The node is named by its name or by its executable."""
    for name in ("dc_motor_smc_b2", "buck_pi"):
        create(tmp_path / name, name, 0.02).make()
    for node, bag in (("dc_motor_smc", "dc_motor_smc_b2"), ("dcdc_plant", "buck_pi")):
        assert checked(tmp_path, node=node) == 0
        assert [line.split(":")[0] for line in capsys.readouterr().out.splitlines()[:-1]] == [bag]
    with pytest.raises(
        ScenarioError, match=r"--with motor: no node or executable of that name in .*; there are .*dcdc"
    ):
        remade([], tmp_path, node="motor")
    with pytest.raises(ScenarioError, match="has no golden bags yet; name the scenarios: `softrig golden SCENARIO`"):
        remade([], tmp_path / "buck_pi")


def test_a_check_writes_its_result_for_continuous_integration(tmp_path):
    golden = create(tmp_path / "dc_motor_smc_b2", "dc_motor_smc_b2", 0.2, 0)
    golden.make()
    files = {"junit": tmp_path / "golden.xml", "json": tmp_path / "golden.json"}
    assert checked(tmp_path, **files) == 0
    about = {"bag": "dc_motor_smc_b2", "scenario": "dc_motor_smc_b2", "duration_s": 0.2, "seed": 0}
    agrees = {**about, "pass": True, "compared": "byte for byte", "differs": ""}
    (row,) = json.loads(files["json"].read_text())
    seconds = row.pop("wall_s")
    assert row == agrees
    assert seconds > 0.0
    assert ET.parse(files["junit"]).find("testsuite").attrib == {
        "name": "dc_motor_smc_b2",
        "tests": "1",
        "failures": "0",
        "errors": "0",
        "time": f"{seconds:.3f}",
    }
    recipe = golden.folder / "golden.yaml"
    recipe.write_text(recipe.read_text().replace("scenario: dc_motor_smc_b2", "scenario: dc_motor_smc_b2_delta2"))
    assert checked(tmp_path, **files) == 1
    (result,) = json.loads(files["json"].read_text())
    assert not result["pass"]
    assert "motor/command" in result["differs"]
    suite = ET.parse(files["junit"]).find("testsuite")
    assert suite.attrib["failures"] == "1"
    assert "motor/command" in suite.find("testcase/failure").attrib["message"]


def test_another_duration_or_seed_keeps_what_was_edited_by_a_person(tmp_path):
    folder = tmp_path / "dc_motor_smc_b1"
    create(folder, "dc_motor_smc_b1", 0.2).make()
    file = folder / "golden.yaml"
    edited = file.read_text().replace("tolerances: {}", "tolerances: {motor/*: {absolute: 0.5}}")
    file.write_text(edited.replace("why: ''", "why: by hand"))
    assert remade([folder.name], tmp_path, duration=0.1) == 0
    assert remade([folder.name], tmp_path, seed=3) == 0
    recipe = load(folder).recipe
    assert (recipe.duration, recipe.seed, recipe.why) == (0.1, 3, "by hand")
    assert recipe.tolerances["motor/*"].absolute == 0.5
    assert Signals(load(folder).recording())["motor/state/shaft/velocity"].t[-1] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"duration": -1.0}, r"golden\.yaml: duration: Input should be greater than 0, got -1"),
        ({"seed": -1}, r"golden\.yaml: seed: Input should be greater than or equal to 0, got -1"),
    ],
)
@pytest.mark.parametrize("recorded_with", [True, False])
def test_an_impossible_golden_run_is_refused_and_changes_nothing(tmp_path, recorded_with, keys, message):
    file = tmp_path / "dc_motor_smc_b1" / "golden.yaml"
    if recorded_with:
        create(file.parent, "dc_motor_smc_b1", 0.1)
    before = file.read_text() if recorded_with else None
    with pytest.raises(ScenarioError, match=message):
        remade(["dc_motor_smc_b1"], tmp_path, **keys)
    assert (file.read_text() if file.exists() else None) == before


def test_the_old_bag_stays_until_the_new_one_is_written(tmp_path):
    golden = create(tmp_path / "dc_motor_smc_b1", "dc_motor_smc_b1", 0.1)
    golden.make()
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))  # simulates a full disk
    try:
        with pytest.raises(RunError, match="not written"):
            golden.make()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def test_a_golden_bag_replaces_only_golden_bags(tmp_path):
    golden = create(tmp_path / "dc_motor_smc_b1", "dc_motor_smc_b1", 0.1)
    golden.make()
    (golden.bag / "notes.txt").write_text("mine")
    with pytest.raises(ScenarioError, match=r"bag/notes\.txt was not made by"):
        golden.make()
    assert (golden.bag / "notes.txt").read_text() == "mine"
    (golden.folder / "golden.yaml").unlink()
    with pytest.raises(ScenarioError, match=r"has a bag and no golden\.yaml"):
        create(golden.folder, "dc_motor_smc_b1", 0.1)
    (tmp_path / "precious").mkdir()
    linked = create(tmp_path / "linked", "dc_motor_smc_b1", 0.1)
    linked.bag.symlink_to(tmp_path / "precious")
    with pytest.raises(ScenarioError, match="linked/bag was not made by"):
        linked.make()
    assert list((tmp_path / "precious").iterdir()) == []


def test_bags_of_equal_runs_are_equal_bit_for_bit(tmp_path):
    golden = load(BAGS / "dc_motor_smc_b1")
    a, b = golden.rerun(), golden.rerun()
    assert compare(Signals(a), Signals(b), bitwise=True).equal
