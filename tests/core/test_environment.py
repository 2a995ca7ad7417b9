"""A rig as a Gymnasium environment: the numbers of the rig, ends of episodes, a policy used as a node."""

import importlib.metadata
import json
import os
import re
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from softrig_bringup.cli import main
from softrig_control.nodes import policy
from softrig_control.nodes.policy import Policy, linear
from softrig_core import (
    Block,
    ByHand,
    ParameterError,
    Plant,
    Recording,
    Rig,
    RigEnv,
    ScenarioError,
    command,
    load_scenario,
    rig_of,
    run_inprocess,
    scalars,
    simulate,
)
from softrig_core.native.batch_text import Form

gymnasium = pytest.importorskip("gymnasium")
check_env = pytest.importorskip("gymnasium.utils.env_checker").check_env
RigVectorEnv = pytest.importorskip("softrig_core.analysis.environments").RigVectorEnv

PAGE = Path(__file__).parents[2] / "ros_pkgs" / "softrig_core" / "doc" / "learning.md"
MOTOR = {"what": "dc_motor_smc", "replace": "dc_motor_smc", "duration": 0.3, "overrides": {"period": 0.01}}


def motor(**keys):
    signals = {"observe": {"speed": (-5.0, 5.0)}, "act": {"voltage": (-12.0, 12.0)}}
    return RigEnv(**MOTOR | signals | {"reward": lambda now: -abs(now["speed"] - now["set_point"])} | keys)


def episode(env, agent, observation):
    steps = []
    while not steps or not (steps[-1][2] or steps[-1][3]):
        steps.append(env.step(agent(observation)))
        observation = steps[-1][0]
    return steps


def messages(recording):
    return {name: list(topic.stream()) for name, topic in recording.topics.items()}


@pytest.mark.parametrize(
    ("name", "law", "duration"),
    [
        ("induction_dtc", "dtc_controller", 0.02),
        ("induction_dtc", "speed_controller", 0.02),
        ("dc_motor_fsfb_s1", "fsfb_controller", 0.5),
        ("rectifier_mpc", "gpc_controller", 0.01),
    ],
)
def test_with_its_own_law_as_agent_it_equals_the_rig_bit_for_bit(name, law, duration):
    rig = rig_of(load_scenario(name).changed(duration=duration))
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    run_inprocess(rig, 3, recording)
    env = RigEnv(rig, law, reward=lambda now: 0.0, record=True)
    for _ in range(2):  # the second time with blocks that have run before
        observation, _ = env.reset(seed=3)
        steps = episode(env, env.published(), observation)
        assert [s[3] for s in steps] == [False] * (len(steps) - 1) + [True]
        assert messages(env.run.recording) == messages(recording)


def test_gymnasiums_checker_finds_no_fault():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # The checker prefers normalised actions and registered environments.
        warnings.filterwarnings("ignore", ".*(normalized space|not having a spec)")
        check_env(motor())
        check_env(RigEnv(**MOTOR, reward=lambda now: 0.0))


def test_spaces_are_those_of_the_ports():
    env = RigEnv(**MOTOR, reward=lambda now: 0.0)
    assert env.action_space == gymnasium.spaces.Box(-1e7, 1e7, (1,), np.float64)  # V
    assert env.observation_space.shape == (sum(p.size for p in env._law.inputs),)
    assert motor().action_space == gymnasium.spaces.Box(-12.0, 12.0, (1,), np.float64)
    beyond = motor(act={"voltage": (-12.0, 1e9)})
    assert beyond.action_space.high[0] == 1e7


def test_an_action_is_cut_at_its_bounds():
    runs = []
    for volts in (12.0, 50.0):
        env = motor(record=True)
        observation, _ = env.reset(seed=0)
        episode(env, lambda o, volts=volts: np.array([volts]), observation)
        runs.append(messages(env.run.recording))
    assert runs[0] == runs[1]


@pytest.mark.long
def test_environments_side_by_side_equal_single_ones():
    one = motor()
    one.reset(seed=5)
    alone = [one.step([3.0])[0].tolist() for _ in range(5)]
    many = gymnasium.vector.SyncVectorEnv([motor] * 3)
    many.reset(seed=[5, 6, 7])
    results = [many.step(np.full((3, 1), 3.0))[0] for _ in range(5)]
    assert [f[0].tolist() for f in results] == alone
    apart = gymnasium.vector.AsyncVectorEnv([motor] * 2, context="spawn")  # spawn, because this process has threads
    try:
        apart.reset(seed=[5, 6])
        assert [apart.step(np.full((2, 1), 3.0))[0].tolist() for _ in range(5)] == [f[:2].tolist() for f in results]
        for _ in range(25):  # each environment ends its episode here
            _, _, terminated, truncated, _ = apart.step(np.full((2, 1), 3.0))
        assert (terminated.tolist(), truncated.tolist()) == ([False] * 2, [True] * 2)
        again = apart.step(np.full((2, 1), 3.0))[0]  # the next episode begins at rest
        assert again.tolist() == [[0.0]] * 2
    finally:
        apart.close()
    registered = gymnasium.make("softrig/Rig-v0", **MOTOR, observe=["speed"], act=["voltage"], reward=lambda now: 0.0)
    registered.reset(seed=5)
    assert [registered.step(np.array([3.0]))[0].tolist() for _ in range(5)] == alone


LEGS = dict.fromkeys((f"switches/{leg}/effort" for leg in ("Sa", "Sb", "Sc")), (0.0, 1.0))
DRIVE = {"what": "induction_dtc", "duration": 0.02, "reward": lambda now: now["currents_meas/x"] - now["speed"]}


@pytest.mark.parametrize(("keys", "size", "least"), [
    (MOTOR | {"observe": ["speed", "motor/sensors/current_a"], "act": ["voltage"], "penalty": -100.0,
              # An action beyond 12 V causes a report.
              "reward": lambda now: -abs(now["speed"] - now["set_point"])}, 14.0, 120),
    pytest.param(MOTOR | {"replace": "motor_reference", "observe": ["speed"], "reward": lambda now: now["voltage"],
                          # One step of the environment lasts several ticks.
                          "overrides": {"motor_reference.period": 0.002}},
                 2.0, 180, marks=pytest.mark.long),
    # A rig that watches this requirement does not run natively.
    (MOTOR | {"reward": lambda now: 0.0, "terminate": ["settles"]}, 1.0, 0),
    pytest.param(DRIVE | {"replace": "dtc_controller", "act": LEGS}, 2.0, 2_400, marks=pytest.mark.long),
    pytest.param(DRIVE | {"replace": "speed_controller"}, 20.0, 180, marks=pytest.mark.long),
])  # fmt: skip
def test_many_environments_in_native_code_equal_single_ones(keys, size, least):
    """They are equal across the ends of episodes, with noise, and where native code discards a tick."""
    one = gymnasium.vector.SyncVectorEnv([lambda: RigEnv(**keys)] * 3)
    many = gymnasium.make_vec("softrig/Rig-v0", num_envs=3, **keys)
    draws = np.random.default_rng(1)
    pairs = [(many.reset(seed=5), one.reset(seed=5))]
    for _ in range(70 if "act" not in keys or keys["act"] is not LEGS else 900):
        actions = draws.uniform(-size, size, many.action_space.shape) * (draws.random((3, 1)) < 0.9)
        pairs.append((many.step(actions), one.step(actions)))
    for result, wanted in pairs:
        for x, y in zip(result[:-1], wanted[:-1], strict=True):
            assert (x.dtype, x.tobytes()) == (y.dtype, y.tobytes())
        infos = [{k: (v.dtype, v.tolist()) for k, v in reported.items()} for reported in (result[-1], wanted[-1])]
        assert infos[0] == infos[1]
    assert many.unwrapped.native >= least
    assert bool(many.unwrapped.reason) == (least == 0)


def test_all_environments_start_again_if_they_are_reset_at_their_end():
    keys = MOTOR | {"observe": ["speed"], "act": ["voltage"], "reward": lambda now: now["speed"], "duration": 0.03}
    many, fresh = (RigVectorEnv(**keys, num_envs=2) for _ in range(2))
    many.reason = fresh.reason = "in Python: each is as quick"
    many.reset(seed=1)
    volts = np.array([[3.0], [5.0]])
    while not many.step(volts)[3].all():
        pass
    for seed in (5, [8, 2]):
        for result, wanted in zip(many.reset(seed=seed), fresh.reset(seed=seed), strict=True):
            assert str(result) == str(wanted)
        assert str(many.step(volts)) == str(fresh.step(volts))
    with pytest.raises(ValueError, match=r"^3 seeds, expected 2$"):
        many.reset(seed=[1, 2, 3])


class Part(NamedTuple):
    angle: float
    on: bool


def test_a_state_with_complex_numbers_is_restored_as_it_was_stored():
    state = ((1.0 + 2.0j, 3, Part(-4.5, True)), None, (5.0j, (0.25, False)))
    form = Form(state)
    numbers, whole = np.zeros(form.sizes[0]), np.zeros(form.sizes[1], np.int64)
    form.put(state, numbers, whole)
    assert repr(form.get(numbers, whole)) == repr(state)


def test_a_seed_is_that_of_the_rig_and_random_without_one():
    env = RigEnv("induction_dtc", "dtc_controller", observe=["i_a"], reward=lambda now: 0.0, duration=0.005)
    law = np.array([1.0, 0, 0, 0, 0, 0, 0])  # all outputs of the controller: one leg is on

    def noise(**keys):
        env.reset(**keys)
        return [env.step(law)[0].tolist() + [env.now["currents_meas/x"]] for _ in range(20)]

    first = noise(seed=1)
    drawn = noise()
    assert noise(seed=2) != first != drawn
    assert noise(seed=1) == first
    assert noise() == drawn


def test_an_episode_does_not_depend_on_the_previous_one():
    env = motor()
    for volts in (3.0, 4.0):
        env.reset(seed=0)
        with pytest.raises(KeyError):
            env.now["voltage"]
        env.step([volts])
        assert env.now["voltage"] == volts


def test_a_violated_requirement_ends_an_episode():
    bounded = rig_of(load_scenario("dc_motor_smc", {"period": 0.01}).changed(duration=0.3))
    scenario = bounded.scenario.model_copy(update={"requirements": {}})
    data = scenario.model_dump() | {"requirements": {"slow": "always abs(speed) <= 0.5"}}
    env = motor(what=type(scenario).model_validate(data), terminate=["slow"], penalty=-7.0, overrides={})
    observation, _ = env.reset(seed=0)
    steps = episode(env, lambda o: np.array([12.0]), observation)
    _, reward, terminated, truncated, info = steps[-1]
    assert (terminated, truncated) == (True, False)
    assert "abs(speed) <= 0.5 is violated" in info["error"]
    assert reward == pytest.approx(-7.0 - abs(env.now["speed"] - 1.0))
    assert len(steps) < 30
    with pytest.raises(RuntimeError, match=r"no episode is under way: reset\(\) begins one"):
        env.step([0.0])
    assert env.reset(seed=0)[0].tolist() == observation.tolist()  # the environment stays usable


class Tank(Plant):
    INPUTS = (command("pump", "tank/pump", ["pump"], "V"),)
    OUTPUTS = (scalars("level", "tank/level", {"height": "m"}, limits=(1.0,)),)

    def first(self):
        return 0.0

    def outputs(self, x, t):
        return {"level": (x,)}

    def advance(self, x, t, pump):
        return x + 0.1 * pump[0]


class Valve(Block):
    INPUTS, OUTPUTS = Tank.OUTPUTS, Tank.INPUTS

    def update(self, x, t, level):
        return x, {"pump": (1.0 - level[0],)}


@pytest.mark.parametrize(("action", "last"), [({}, 0.9), ({"penalty": -1.0}, -0.1)])
def test_a_value_beyond_the_limits_of_its_port_ends_an_episode(action, last):
    rig = Rig.from_blocks({"tank": Tank(), "valve": Valve()}, duration=1.0)
    env = RigEnv(rig, "valve", reward=lambda now: now["tank/level/height"], **action)
    observation, _ = env.reset(seed=1)
    steps = episode(env, lambda o: np.array([3.0]), observation)
    assert len(steps) == 4
    assert steps[-1][1:4] == (pytest.approx(last), True, False)
    assert "tank: level height/position became 1.2 m, expected at most 1" in steps[-1][4]["error"]
    assert env.rig.scenario.nodes["valve"].package == "softrig_control"


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"replace": "dc_motor_plant"}, "it is a plant or publishes nothing; expected one of"),
        ({"replace": "dc_motor_smcc"}, "it is not there.*dc_motor_smc"),
        ({"observe": ["sped"]}, "no signal 'sped'.*speed"),
        ({"act": ["speed"]}, "does not publish motor/state/shaft/velocity; it publishes motor/command/armature/effort"),
        ({"terminate": ["none"]}, "no requirement 'none'; expected one of settles"),
        ({"act": {"voltage": (1.0, 1.0)}}, "1 is not below 1"),
        ({"observe": ["voltage"]}, "cycle without a plant"),
        ({"observe": []}, "observe: expected signals"),
    ],
)
def test_a_rig_that_cannot_be_an_environment_is_reported(keys, message):
    with pytest.raises(ScenarioError, match=message):
        motor(**keys)


@pytest.mark.parametrize("action", [[np.nan], [np.inf], [1.0, 2.0], 1.0, []])
def test_a_bad_action_is_refused(action):
    env = motor()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"expected an action of \(1,\) finite numbers"):
        env.step(action)
    env.step([1.0])  # the episode continues after the refused action


def test_a_reward_that_is_not_a_number_is_reported():
    env = motor(reward=lambda now: float("nan"))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"the reward became nan at t = 0.01 s"):
        env.step([1.0])


def test_a_policy_as_a_node_equals_the_agent_bit_for_bit():
    weights = [-3.0, 0.25]
    env = motor(record=True)
    observation, _ = env.reset(seed=0)
    act = linear(weights, 1, 1)
    episode(env, lambda o: np.array(act(o.tolist())), observation)
    again = simulate(env.scenario("linear", weights), seed=0)
    assert messages(again.recording) == messages(env.run.recording)


class Point:
    names = ("mine", "number")

    def __getitem__(self, name):
        class Entry:
            value = "mine:make"

            def load(self):
                return (
                    3 if name == "number" else lambda weights, observations, actions: lambda y: [weights[0]] * actions
                )

        return Entry()


def test_only_registered_policies_are_found(monkeypatch):
    with pytest.raises(ParameterError, match="policy = 'os:system': expected one of linear; a package registers"):
        Policy(policy="os:system")
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: Point())
    policy = ByHand(Policy(policy="mine", weights=(4.0,), high=(3.0,), low=(-3.0,)))
    outputs = policy.update(0, state=(1.0,))
    assert outputs == {"command": (3.0,)}
    with pytest.raises(ParameterError, match="mine:make is a int, expected a function"):
        Policy(policy="number")
    with pytest.raises(ParameterError, match=r"1 observations and 1 actions has 2 weights.*got 3"):
        Policy(weights=(1.0, 2.0, 3.0))


def test_a_policy_is_rewound_with_its_memory(monkeypatch):
    def make(weights, observations, actions):
        total, rows = 0.0, [0.0]

        def act(observed):
            nonlocal total
            total += observed[0]
            rows[0] += 1.0
            return [total * rows[0]]

        return act

    monkeypatch.setattr(policy, "find", lambda name: make)
    node = ByHand(Policy(policy="sum"))
    node.update(0, state=(1.0,))
    saved = node.save()
    for _ in range(2):
        node.load(saved)
        assert [node.update(0, state=(1.0,))["command"] for _ in range(2)] == [(4.0,), (9.0,)]


SHAKY = """
def made(weights, observations, actions):
    last = [0.0] * actions

    def act(observed):
        last[:] = [weights[0] * u + weights[1] * (1.0 - observed[0]) for u in last]
        return list(last)

    return act
"""


@pytest.mark.long
def test_a_policy_of_an_installed_package_runs_as_a_node_and_is_judged_as_the_law(tmp_path, monkeypatch, capsys):
    about = tmp_path / "shaky_policies-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: shaky-policies\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[softrig_policies]\nshaky = shaky_policies:made\n")
    (tmp_path / "shaky_policies.py").write_text(SHAKY)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    trained = motor(duration=1.2).scenario("shaky", [0.9, 2.0], name="shaky_motor")
    run = simulate(trained)
    assert run.figures["rise_time"] > 0.0
    assert set(run.figures) == set(simulate("dc_motor_smc", overrides={"period": 0.01}).figures)
    act, speed, last = (
        run.signals["motor/command/armature/effort"][1],
        run.signals["motor/state/shaft/velocity"][1],
        0.0,
    )
    for u, w in zip(act.tolist(), speed.tolist(), strict=False):  # the policy has a memory, which a run must reset
        last = 0.9 * last + 2.0 * (1.0 - w)
        assert u == min(max(last, -12.0), 12.0)
    file = tmp_path / "shaky_motor.yaml"
    file.write_text(json.dumps(trained.model_dump(mode="json", exclude={"name"})))
    main(["run", str(file), "--mode", "container", "--out", str(tmp_path / "out"), "--no-plots"])
    capsys.readouterr()
    content = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert {m["name"]: m["value"] for m in content["metrics"]} == {r.name: r.value for r in run.results}
    assert content["mode"] == "container"


@pytest.mark.long
def test_the_page_trains_a_policy_and_its_statements_hold(tmp_path, monkeypatch, capsys):
    pytest.importorskip("cmaes")
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    known = {"__name__": "page"}
    for block in blocks[:3]:
        exec(block, known)
    shown = re.search(r"```text\n(.*?)```", text, re.DOTALL)[1]
    shown_numbers, printed = (
        [float(n) for n in re.findall(r"\b\d[\d.]*", t)] for t in (shown, capsys.readouterr().out)
    )
    assert printed[1::2] == shown_numbers[1::2] == [0.62, 1.18, 0.0]  # the lines of the controller
    assert printed[::2] == pytest.approx(
        shown_numbers[::2], rel=0.2, abs=0.01
    )  # other last bits lead the search to a slightly different policy
    assert all(policy < law for policy, law in zip(printed[:4:2], printed[1:4:2], strict=True))
    written = load_scenario(str(tmp_path / "dc_motor_policy.yaml"))
    assert simulate(written, duration=3.0).figures == known["run"].figures
    env, act, sent = known["env"], linear(known["best"][1].tolist(), 2, 1), []
    observed, done = env.reset(seed=0)[0], False
    while not done:
        sent.append(float(np.clip(act(observed.tolist()), -12.0, 12.0)[0]))
        observed, _, terminated, truncated, _ = env.step(sent[-1:])
        done = terminated or truncated
    node = known["run"].signals["motor/command/armature/effort"].x[: len(sent)].tolist()
    assert (len(sent) > 50, sent) == (True, node)  # equal up to the last bit
    exec(blocks[3], known)
    act = known["damped"]([0.5, 2.0], 1, 1)
    assert [act([1.0]), act([1.0])] == [[2.0], [3.0]]
    exec(blocks[4].replace("256", "2"), known)
    assert known["observations"].shape == (2, *known["envs"].single_observation_space.shape)
