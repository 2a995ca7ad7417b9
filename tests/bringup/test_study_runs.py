"""One run of a study: its row is the one of the same run alone, whatever has run before it in the process."""

import copy
import hashlib
import json
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from operator import itemgetter

import pytest
from softrig_bringup.study.definition import make_study
from softrig_bringup.study.draw import Case
from softrig_bringup.study.engine import run_study
from softrig_bringup.study.work import Work, run
from softrig_core.scenario.scenario import read_draft

DRIVE = [
    {"im_plant.R_s": 3.7},
    {"im_plant.R_s": 3.9},  # the same figures and requirements as before
    {"im_plant.bits": 12},  # changes an argument of a figure, by `agreed`
    {"im_plant.U_dc": 500.0},  # changes a constant of a requirement
    {"im_plant.J": 1e-9},  # this run fails
    {"im_plant.adc_mode": "none"},  # uses no random numbers, and other generated code
    {"dtc_controller.estimator": "observer"},
    {"dtc_controller.magnetising_time": 0.008, "dtc_controller.flux_ramp": 0.008},  # shifts the window of the figures
    {"load_source.times": [0.0, 0.018], "load_source.values": [0.0, 5.0]},
    {"im_plant.period": 2.5e-5, "dtc_controller.period": 2.5e-5},  # other tick times
    {"im_plant.trip_current": 3.0},
    {"im_plant.R_s": 3.7},
]
MOTOR = [
    {"dc_motor_smc.delta": 0.5},
    {"noise.value": [0.2]},
    {"drift.from": 0.05, "drift.value": [1.0]},
    {"dc_motor_plant.R": 1e9},
    {"dc_motor_smc.delta": 5.0},
    {"dc_motor_smc.delta": 0.5},
]


def drive():
    """Return the drive with all figures and requirements, at a hundredth of its times."""
    draft = read_draft("induction_dtc")
    raw = copy.deepcopy(draft.raw)
    raw["shared"] |= {"steady": 0.015}
    raw["nodes"]["load_source"]["parameters"]["times"] = [0.0, 0.016]
    raw["nodes"]["speed_source"]["parameters"]["times"] = [0.0, 0.012]
    raw["nodes"]["dtc_controller"]["parameters"] = {"magnetising_time": 0.009, "flux_ramp": 0.009}
    raw["requirements"]["tracks"]["formula"] = "always[loaded + 0.001, inf] abs(speed - set_speed) <= set_speed"
    for name in ("flux_error_slope", "adc_error_mean", "adc_error_std"):
        raw["figures"][name].setdefault("arguments", {})["start"] = 0.005
    return replace(draft, raw=raw)


# Each study: its draft, duration and overrides.
STUDIES = {"drive": (drive, 0.02, DRIVE), "faults": (partial(read_draft, "dc_motor_smc_faults"), 1.0, MOTOR)}


def works(study, draft, runs=2):
    _, duration, overrides = STUDIES[study]
    cases = [Case(k, draft.name, "", each, 1 + k // 3 % 2) for k, each in enumerate(overrides)]
    return [Work(case, duration=duration, runs=runs, scenario=draft) for case in cases]


def content(row):
    return json.dumps({key: value for key, value in row.items() if key not in ("wall_s", "number")})


@pytest.mark.parametrize("study", STUDIES)
def test_a_row_does_not_depend_on_the_runs_before_it(study):
    make, draft = STUDIES[study][0], STUDIES[study][0]()
    rows = [content(run(work)) for work in works(study, draft)]
    # Another draft shares nothing that was read from the scenario.
    alone = [content(run(work)) for work in reversed(works(study, make()))]
    assert rows == alone[::-1]
    assert len(set(rows)) == len(rows)  # the first and the last one differ in their seeds


def digest_alone(works):
    """Run cases and return the digest of their rows; for a process of its own."""
    return hashlib.sha256("".join(content(run(work)) for work in works).encode()).hexdigest()


@pytest.mark.long
def test_the_rows_of_a_whole_study_have_the_digest_of_separate_processes(tmp_path):
    grid = {"im_plant.U_dc": [500.0, 520.0, 540.0], "im_plant.R_s": [3.6, 3.8]}
    asked = {
        "name": "whole",
        "title": "whole",
        "scenario": "induction_dtc",
        "duration": 0.2,
        "grid": grid,
        "seeds": [1, 2],
    }
    study = make_study(asked)
    rows = sorted(run_study(study, tmp_path, workers=2).rows(), key=itemgetter("number"))
    cases = [Case(*(row[name] for name in Case._fields)) for row in rows]
    alone = [Work(case, study.duration, runs=len(rows), scenario=None) for case in cases]
    # Each process runs one case, so no other run can affect it.
    with get_context("spawn").Pool(2, maxtasksperchild=1) as pool:
        digests = pool.map(digest_alone, [[work] for work in alone], chunksize=1)
    assert len(set(digests)) == len(rows) == 12
    assert digests == [hashlib.sha256(content(row).encode()).hexdigest() for row in rows]
