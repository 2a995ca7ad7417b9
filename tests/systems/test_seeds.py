"""All random numbers of a run come from the rig's seed: another seed gives other numbers, the same seed the same."""

import hashlib
import re
from pathlib import Path

import pytest
from softrig_core import simulate

# Scenarios with random numbers, one for each use, and the time after which they have an effect.
DRAWS = {
    "induction_dtc": ("dither bits", 0.01),
    "dc_motor_fsfb_stretch_jitter": ("jitter of a delay", 1.0),
    "pv_mppt_s4": ("light of a source", 0.05),
    "pv_mppt": ("first population of a search", 0.5),
    "tcp_aqm_smc_s4": ("flows of a queue", 1.0),
    "fault_location_noise": ("noise of instruments", 0.001),
    "fault_location_gwo": ("wolves", 0.05995),
    "fault_location_woa": ("whales", 0.05995),
    "economic_dispatch_pso": ("particles", 1.0),
    "pwa_delay_p2_telegraph": ("jumps of a delay", 60.0),
    "dc_motor_smc_faults": ("noise of a fault", 3.0),
}
SWARMS = {  # a smaller search also uses random numbers
    "fault_location_gwo": {"fault_locator.n_pop": 10, "fault_locator.n_iter": 5},
    "fault_location_woa": {"fault_locator.n_pop": 10, "fault_locator.n_iter": 5},
    "economic_dispatch_pso": {"dispatch_solver.n_pop": 10, "dispatch_solver.n_iter": 5},
}


def digest(scenario, seed, duration):
    recording = simulate(scenario, seed=seed, duration=duration, overrides=SWARMS.get(scenario)).recording
    result = hashlib.sha256()
    for name, topic in sorted(recording.topics.items()):
        result.update(name.encode())
        for data in topic.data:
            result.update(data)
    return result.hexdigest()


LONG = {"pwa_delay_p2_telegraph", "pv_mppt_s4", "fault_location_woa"}


@pytest.mark.parametrize("scenario", [pytest.param(s, marks=[pytest.mark.long] * (s in LONG)) for s in DRAWS])
def test_another_seed_gives_another_run_and_the_same_seed_the_same(scenario):
    _, duration = DRAWS[scenario]
    first, other, again = (digest(scenario, seed, duration) for seed in (0, 1, 0))
    assert first == again
    assert first != other


OWN = {  # generators that do not use the seed of the rig, by file: their number and the reason
    "softrig_core/block/block.py": (1, "the one of a rig's seed"),
    "softrig_core/kit/draws.py": (1, "of what it is given"),
    "softrig_optim/search.py": (1, "of what it is given; a node gives that of the rig"),
    "softrig_systems/pwa_delay/profiles.py": (1, "of what it is given"),
    "softrig_power/dispatch/baselines.py": (1, "of what it is given"),
    "softrig_systems/tcp_aqm/packets_plant.py": (1, "of the rig's, and of a parameter that is added"),
    "softrig_power/fault_location/locator.py": (1, "of the rig's, and of a parameter that is added"),
    "softrig_power/fault_location/method/objective.py": (1, "of a record without a rig"),
    "softrig_power/fault_location/study.py": (1, "of a record without a rig"),
    "softrig_systems/pwa_delay/proof/applicability.py": (1, "points at which a region is looked at, always the same"),
    "softrig_systems/pwa_delay/system.py": (3, "points at which a region is looked at, always the same"),
    "softrig_core/drawing/robot.py": (1, "poses by which a picture is framed, always the same"),
    "softrig_optim/optimiser.py": (1, "of a search that is made to check its parameters, and is not run"),
    "softrig_power/pv/mppt.py": (1, "of a search that is made to check its parameters, and is not run"),
    "softrig_bringup/falsify/search.py": (2, "of the search over rigs, --seed"),
    "softrig_bringup/study/draw.py": (1, "of the draws of a study, which names it"),
    "softrig_bringup/study/estimate.py": (2, "of bootstraps, always the same: intervals repeat"),
    "softrig_core/export/drawn.py": (1, "of inputs to which exported C is held"),
}


def test_there_are_no_other_random_numbers():
    root = Path(__file__).parents[2] / "ros_pkgs"
    results = {}
    for path in root.glob("*/softrig_*/**/*.py"):
        text = path.read_text(encoding="utf-8")
        if path.parent.name == "rig" and path.stem in ("contents", "outside"):
            continue  # these read the generators of other files and draw no numbers
        assert not re.search(r"^import random|np\.random\.(?!default_rng|Generator)", text, re.M), path
        if count := len(re.findall(r"default_rng\(|\bRandom\(", text)):
            results[str(path.relative_to(root)).partition("/")[2]] = count
    assert results == {name: count for name, (count, _) in OWN.items()}
