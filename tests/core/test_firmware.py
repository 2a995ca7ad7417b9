"""Firmware in simulators of its boards: the same answers as on this machine, and figures of code and time."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from softrig_core import ScenarioError, rig_of, simulate
from softrig_core.board.simavr import HEADER
from softrig_core.export.check import TOOLS
from softrig_core.firmware.check import CORE, DEBIAN, FLASH, RAM, checked
from softrig_core.firmware.files import export_firmware
from softrig_core.scenario.scenario import merge, read_draft

avr = pytest.mark.skipif(
    not (shutil.which("avr-gcc") and CORE.is_dir() and HEADER.is_file() and shutil.which("cc")),
    reason=f"needs an AVR compiler, the Arduino core and simavr (Debian: {DEBIAN})",
)
arm = pytest.mark.skipif(
    not (shutil.which("arm-none-eabi-gcc") and shutil.which("qemu-system-arm") and shutil.which("cc")),
    reason=f"needs an Arm compiler and qemu (Debian: {TOOLS})",
)


@pytest.mark.long
@avr
def test_a_sketch_on_the_uno_moves_the_motor_as_python_does(tmp_path):
    name, layout = export_firmware(rig_of("dc_motor_smc_b2"), "dc_motor_smc", tmp_path, "arduino", rows=60, drawn=30)
    result = checked(tmp_path, name, layout, "arduino")
    assert result.rows >= 80
    assert result.differing == 0
    # Cycles; 3,567 were the most that a prototype needed, without subnormal numbers.
    assert 3000 < result.longest < 8000
    assert result.flash < FLASH / 3
    assert result.ram + result.stack < RAM / 2
    draft = read_draft("dc_motor_smc_b2")
    link = {"nodes": {"dc_motor_smc": {"link": {"port": f"simavr:{tmp_path / name}.elf", "firmware": str(tmp_path)}}}}
    gains = {"changes": [{"at": 0.1, "set": {"dc_motor_smc.k_per_ref": 4.0}}]}
    rigs = [rig_of(replace(draft, raw=merge(draft.raw, raw))) for raw in (merge(link, gains), gains)]
    board, python = (simulate(rig, duration=0.3).recording.topics for rig in rigs)
    assert board["motor/true_state"].data == python["motor/true_state"].data
    assert board["motor/command"].data != python["motor/command"].data  # the board computes in single precision


@pytest.mark.long
@arm
def test_a_cortex_m_has_the_bits_of_python(tmp_path):
    name, layout = export_firmware(rig_of("dc_motor_smc_b2"), "dc_motor_smc", tmp_path, "cortex-m4", rows=60, drawn=30)
    result = checked(tmp_path, name, layout, "cortex-m4")
    assert result.rows >= 80
    assert result.differing == 0
    assert 500 < result.longest < 6000
    assert 0 < result.stack < 2048
    assert json.loads((tmp_path / f"{name}.json").read_text())["machine"] == "mps2-an386"


@avr
@pytest.mark.long
def test_a_node_too_large_for_an_uno_is_refused_with_its_sizes(tmp_path):
    name, layout = export_firmware(rig_of("dc_motor_smc_b2"), "dc_motor_smc", tmp_path, "arduino", rows=20, drawn=5)
    main = next(tmp_path.glob("*.ino"))
    main.write_text(
        f"volatile char wide[1200];\n{main.read_text()}".replace("void setup()\n{", "void setup()\n{ wide[9]++;")
    )
    with pytest.raises(ScenarioError, match=r"does not fit an Uno: \d+ of 32256 bytes of flash, 1\d\d\d bytes of RAM"):
        checked(tmp_path, name, layout, "arduino")


def test_a_sketch_has_the_name_of_its_folder(tmp_path):
    folder = tmp_path / "speed"
    export_firmware(rig_of("dc_motor_smc_b2"), "dc_motor_smc", folder, "arduino", rows=20, drawn=5)
    assert [p.name for p in folder.glob("*.ino")] == ["speed.ino"]
    assert "#define SR_FLOAT" in Path(folder, "dc_motor_smc.h").read_text()
    assert json.loads((folder / "dc_motor_smc.json").read_text())["real"] == "float"
