"""A node that is killed comes back with its state and its tick: the run says what it says without the kill."""

import random

import pytest
from conftest import differences
from simulated import Discovery, SimulatedRig, World
from test_discovery import KINDS, MS, perhaps_prompt, rig_and_record


def killed(kind, seed, kills=1):
    """One run in which nodes are killed at times that are drawn; gives what is wrong with it, and who was killed."""
    rng = random.Random(seed)
    rig, expected = rig_and_record(kind)
    longest = rng.choice((1, 5, 20)) * MS
    world = World(lambda *_: rng.randrange(1_000, longest), prompt=perhaps_prompt(seed))
    Discovery(world, rng)
    run = SimulatedRig(rig, world, "lockstep", after=lambda name: rng.randrange(300 * MS), returns=True)
    may = [m.name for m in rig.members if not any(p.delayed for p in m.outputs)]
    victims = []

    def kill():
        name = rng.choice(may)
        if run.kill(name, rng):
            victims.append((name, run.adapters[name].t))

    for _ in range(kills):
        world.at(world.now + rng.randrange(round(1.5e3 * MS)), kill)
    states = run.run(100.0)
    wrong = [f"{m.name} has not come" for m in rig.members if m.name not in states]
    wrong += [f"{n}: {a.state} at {a.t}: {a.error}" for n, a in run.adapters.items() if a.state != "done"]
    wrong += differences(expected, run.recording)
    wrong += [f"{n} refused {i.port.topic}: {i.last_refusal}" for n, a in run.adapters.items()
              for i in (*a.inputs, *a.paces) if i.refused]  # fmt: skip
    return wrong, victims


@pytest.mark.parametrize("kind", KINDS)
def test_a_killed_node_comes_back(kind):
    for seed in range(6):
        assert killed(kind, seed)[0] == [], seed
