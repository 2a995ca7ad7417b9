"""Output does not depend on Python's hash seed: no set decides an order."""

import inspect
import os
import re
import subprocess
import sys

import pytest
from softrig_core import figures_of, rig_of

SCRIPT = """
import contextlib, io, sys
from softrig_bringup.cli import main
from softrig_core import list_scenarios, load_scenario, rig_of
from softrig_core.block.params import flatten
from softrig_core.verdict.figures import figure_parameters
for line in (["run", "dc_motor_smc_b1", "--duration", "0.5"], ["run", "dc_motor_smc_faults", "--duration", "0.3"],
             ["run", "gupfc_short", "--duration", "0.02"]):
    with contextlib.redirect_stdout(io.StringIO()):
        main([*line, "--mode", "inprocess", "--out", line[1]])
with contextlib.redirect_stdout(open("said.txt", "w")):
    main(["signals", "tcp_aqm_smc"])
    main(["signals", "economic_dispatch"])
with open("told.txt", "w") as file:
    for name in sorted(list_scenarios())[::7]:
        rig = rig_of(name)
        agreed = [(m.name, flatten(m.params), m.block_class.agreed(m.params)) for m in rig.members]
        print(name, figure_parameters(rig), agreed, file=file)
"""
# values that depend on the wall clock
CLOCK = rb'"wall_s": [-\d.e+]+|wall_s: .*|[\d.]+ s</dd>|[\d.]+ \xc3\x97 real time'


def test_figures_have_their_arguments_in_the_order_of_the_function():
    for figure in figures_of(rig_of("dc_motor_smc_b1")):
        if names := list(figure.arguments):
            order = list(inspect.signature(figure.function).parameters)
            assert names == sorted(names, key=order.index)


@pytest.mark.long
def test_all_output_is_the_same_under_any_hash_seed(tmp_path):
    written = []
    for seed in ("0", "1", "2"):
        folder = tmp_path / seed
        folder.mkdir()
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        subprocess.run([sys.executable, "-c", SCRIPT], cwd=folder, env=environment, check=True, timeout=300)
        files = {str(p.relative_to(folder)): p for p in sorted(folder.rglob("*")) if p.is_file()}
        folder_bytes = str(folder).encode()
        written.append(
            {name: re.sub(CLOCK, b"", path.read_bytes().replace(folder_bytes, b"")) for name, path in files.items()}
        )
    assert len(written[0]) > 20
    for other in written[1:]:
        assert other.keys() == written[0].keys()
        assert [name for name in other if other[name] != written[0][name]] == []
