"""A pack from another person: only data until it is confirmed, code from one folder, figures computed from its
own bag.
"""

import argparse
import io
import json
import os
import shutil
import socket
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml
from softrig_bringup.cli import main
from softrig_bringup.new.native import new_native
from softrig_bringup.options.identity import asked_half, bagged_half, recorded_half
from softrig_bringup.pack import brought, cargo, packed, sandbox, signature, trust
from softrig_bringup.pack.packed import About
from softrig_bringup.verbs import pack
from softrig_bringup.verbs.new import new_package
from softrig_control.c_member import build
from softrig_core import ScenarioError, rig_of
from softrig_core.kit import confined

NAME = "stranger_rig"
TOUCH = "from pathlib import Path\nPath({place!r}).touch()\n"


def zipped(path, files):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def about(**more):
    return json.dumps({"format": 1, "scenario": NAME, "packages": {NAME: "0.0.1"}} | more)


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """The files that `softrig new` writes, by place in a pack."""
    folder = new_package(NAME, tmp_path_factory.mktemp("new"))
    files = {f"packages/{NAME}/{f.relative_to(folder)}": f.read_text() for f in folder.rglob("*") if f.is_file()}
    return files | {f"scenario/{NAME}.yaml": (folder / f"scenarios/{NAME}.yaml").read_text()}


@pytest.fixture(autouse=True)
def alone(tmp_path, monkeypatch):
    """Separate cache, environment and modules for the test; no terminal."""
    for module in (packed, brought, sandbox):
        monkeypatch.setattr(module, "cache_folder", lambda: tmp_path / "cache")
    for name in ("SOFTRIG_SCENARIOS", "AMENT_PREFIX_PATH", "PYTHONPATH"):
        monkeypatch.setenv(name, os.environ.get(name, ""))
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setenv(confined.STRANGE, "")  # registered here so that monkeypatch removes what a confirmation sets
    monkeypatch.setattr(sandbox, "command", lambda options: None)
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    packed.opened.cache_clear()
    yield
    forget()


def forget():
    for name in [name for name in sys.modules if name.partition(".")[0] == NAME]:
        del sys.modules[name]


def run(file, *words, out="again"):
    return main(["run", "--like", str(file), "--mode", "inprocess", "--no-plots", "--out", out, *words])


def test_code_runs_only_after_confirmation(sources, tmp_path, capsys, monkeypatch):
    """Refused without a terminal, refused by any answer but yes, run with --trust, and packed again from its run."""
    monkeypatch.chdir(tmp_path)
    touched = tmp_path / "touched"
    plant = f"packages/{NAME}/{NAME}/plant.py"
    files = {"pack.json": about()} | sources | {plant: sources[plant] + TOUCH.format(place=str(touched))}
    file = zipped(tmp_path / "x.softrig.zip", files)
    assert run(file) == 2
    printed = capsys.readouterr().err
    assert "has code that would run here" in printed
    assert f"package {NAME} 0.0.1: 10 files, " in printed
    assert "its code runs only when somebody confirms it; read it first, then add --trust" in printed
    for answer in ("\n", "n\n", "yes please\n"):
        monkeypatch.setattr(sys, "stdin", Terminal(answer))
        monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
        assert run(file) == 2
        assert "not confirmed; nothing of it has run" in capsys.readouterr().err
    assert not touched.exists()
    assert NAME not in sys.modules
    monkeypatch.setattr(sys, "stdin", Terminal("y\n"))
    assert run(file) == 1  # a pack without a bag and digests has nothing to compare with
    assert touched.exists()
    assert Path(sys.modules[f"{NAME}.plant"].__file__).is_relative_to(tmp_path / "cache")
    assert not list((tmp_path / "cache/packs").glob("*/packages/**/__pycache__"))


class Terminal:
    def __init__(self, answer):
        self.answer = answer

    def isatty(self):
        return True

    def readline(self):
        return self.answer


@pytest.fixture(scope="module")
def made(sources, tmp_path_factory):
    """A pack with the bag of a run of the package, made where it was confirmed."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        for module in (packed, brought, sandbox):
            patch.setattr(module, "cache_folder", lambda: folder / "cache")
        for name in ("SOFTRIG_SCENARIOS", "AMENT_PREFIX_PATH", "PYTHONPATH"):
            patch.setenv(name, os.environ.get(name, ""))
        patch.setattr(sys, "path", [*sys.path])
        patch.setattr(sandbox, "command", lambda options: None)
        first = zipped(folder / "first.zip", {"pack.json": about()} | sources)
        assert run(first, "--trust", out=str(folder / "run")) == 1
        content = json.loads((folder / "run/metrics.json").read_text())
        forget()
        bag = {f"bag/{f.name}": f.read_bytes() for f in (folder / "run/bag").iterdir()}
    files = {"pack.json": about(code=content["code"], run=content["run"]), "metrics.json": json.dumps(content)}
    return files | sources | bag


def test_looking_at_a_pack_runs_none_of_its_code(made, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plant, touched = f"packages/{NAME}/{NAME}/plant.py", tmp_path / "touched"
    evil = made | {
        plant: TOUCH.format(place=str(touched)),
        f"packages/{NAME}/setup.py": TOUCH.format(place=str(touched)),
    }
    file = zipped(tmp_path / "x.zip", evil)
    path = list(sys.path)
    assert main(["report", str(file)]) == 0
    assert f"computing them needs code: {NAME}" in capsys.readouterr().err
    assert main(["draw", "plot", str(file), "--format", "svg", "--out", "pictures"]) == 0
    assert len(list((tmp_path / "pictures").glob("*.svg"))) == 2
    assert main(["pack", str(file)]) == 2
    assert f"it brings {NAME}, which packing would execute" in capsys.readouterr().err
    assert (tmp_path / "report.html").read_text().count('class="plot"') == 3
    assert not touched.exists()
    assert sys.path == path
    assert NAME not in sys.modules


def test_a_confirmed_pack_repeats_number_for_number(made, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(zipped(tmp_path / "x.zip", made), "--trust") == 0
    printed = capsys.readouterr().err.splitlines()
    assert printed[-1].startswith("softrig: repeats ")
    assert not [line for line in printed if "the bag gives" in line or "belong" in line]


@pytest.mark.long
def test_a_study_carries_its_code_and_repeats_after_confirmation(made, tmp_path, capsys, monkeypatch):
    """Packed where the package is, refused without confirmation, repeated row for row with --trust."""
    monkeypatch.chdir(tmp_path)
    for place, text in made.items():
        if place.startswith(f"packages/{NAME}/"):
            file = tmp_path / "src" / place.removeprefix("packages/")
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
    (tmp_path / "mine.yaml").write_text(made[f"scenario/{NAME}.yaml"])
    words = ["--draw", f"{NAME}_controller.r=0.5..2", "--draws", "2", "--workers", "1", "--duration", "0.1"]
    with pytest.MonkeyPatch.context() as patch:  # within this context the package can be imported
        patch.setattr(sys, "path", [*sys.path])
        for name in ("AMENT_PREFIX_PATH", "PYTHONPATH"):
            patch.setenv(name, os.environ.get(name, ""))
        patch.setattr(pack, "_sources", lambda name: tmp_path / "src" / name)
        run(zipped(tmp_path / "x.zip", made), "--trust")
        assert main(["study", "mine.yaml", *words, "--out", "s"]) == 0
        capsys.readouterr()
        assert main(["pack", "s", "--out", "s.zip"]) == 0
        assert "scripts/softrig study --like s.zip --trust" in capsys.readouterr().out
    forget()
    assert main(["study", "--like", "s.zip", "--workers", "1", "--out", "a"]) == 2
    assert "has code that would run here" in capsys.readouterr().err
    assert NAME not in sys.modules
    assert main(["study", "--like", "s.zip", "--trust", "--workers", "1", "--out", "a"]) == 0
    assert "repeats s.zip row for row" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("yaml", "a library's that softrig uses"),
        ("numba", "a library's that softrig uses"),
        ("fmpy", "a library's that softrig uses"),
        ("std_msgs", "one runs, not the one in the pack"),
        ("json", "Python's own"),
        ("sitecustomize", "Python's own"),
        ("usercustomize", "Python's own"),
        ("softrig_core", "softrig's own"),
        ("softrig_extra", "softrig's own"),
        ("Softrig_core", "softrig's own"),
        ("pytest", "a library's that"),
        ("PyYAML", "a library's that is installed here"),
    ],
)
def test_a_package_with_the_name_of_another_is_refused(name, text, sources, tmp_path, capsys):
    files = {k.replace(NAME, name): v.replace(NAME, name) for k, v in sources.items()}
    file = zipped(tmp_path / "x.zip", {"pack.json": about(scenario=name, packages={name: "1"})} | files)
    path = list(sys.path)
    assert run(file, "--trust") == 2
    assert text in capsys.readouterr().err
    assert sys.path == path


OUTSIDE = "nodes:\n  x: {package: softrig_bags, executable: tape, parameters: {bag: /etc/passwd}}"
SETUP = f"packages/{NAME}/setup.cfg"


@pytest.mark.parametrize(
    ("place", "old", "new", "message"),
    [
        (SETUP, f"share/{NAME} =", "../../../../home =", "expected them in share/"),
        (SETUP, f"share/{NAME} =", "/etc/cron.d =", "expected them in share/"),
        (SETUP, f"share/{NAME} =", "bin =", "expected them in share/"),
        (SETUP, f"share/{NAME} =", f"share/{NAME}/../x =", "expected them in share/"),
        (SETUP, f"{NAME}.plant:", "os:", "expected NAME = "),
        (SETUP, f"{NAME}_plant =", "../../x =", "expected NAME = "),
        (SETUP, "console_scripts", "softrig_preloaded", "entry points of 'softrig_preloaded'"),
        (SETUP, "console_scripts", "softrig_figures =\n    rise_time = stranger_rig.plant:tool\nconsole_scripts",
         "the figure function rise_time exists already"),
        (SETUP, f"name = {NAME}", "name = softrig_core", "name = 'softrig_core', expected"),
        (SETUP, "[options]", "[options", "setup.cfg: "),
        (f"scenario/{NAME}.yaml", f"package: {NAME}", "package: pip", "which pack.json does not name"),
        (f"scenario/{NAME}.yaml", "nodes:", OUTSIDE, "names '/etc/passwd', a file outside of the pack"),
    ],
)  # fmt: skip
def test_a_path_out_of_the_folder_is_refused(place, old, new, message, sources, tmp_path, capsys):
    assert place != SETUP or old in sources[place]
    text = sources[place].replace(old, new)
    file = zipped(tmp_path / "x.zip", {"pack.json": about()} | sources | {place: text})
    path = list(sys.path)
    assert run(file, "--trust") == 2
    assert message in capsys.readouterr().err
    assert sys.path == path
    assert not list((tmp_path / "cache/packs").glob("*-code*"))


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ({"packages/other_rig/other_rig/__init__.py": ""}, "pack.json names no such package"),
        ({f"packages/{NAME}/{NAME}/__pycache__/x.pyc": ""}, "expected sources alone"),
        ({f"packages/{NAME}/x.pth": "import os"}, "expected sources alone"),
        ({"bag/extra": "x"}, "expected metadata.yaml and files of messages"),
        ({"bag/bag_0.mcap": bytes(1000)}, "bag"),
        ({"metrics.json": "x", "pack.json": about(files={"metrics.json": "0" * 64})}, "is not the file that pack.json"),
        ({f"scenario/{NAME}.yaml": None}, "no scenario/stranger_rig.yaml in it"),
        ({"scenario/zeros": bytes(packed.SMALL + 1)}, "expected at most 100 times its own size"),
        ({f"scenario/{'é' * 150}": "x"}, "expected plain files below"),
        ({f"scenario/{'é' * 100}/{'/'.join(['é' * 120] * 15)}": "x"}, "expected plain files below"),
        ({"bag/metadata.yaml": "[" * 100_000}, "metadata.yaml is no YAML: nested deeper than 40 levels"),
        ({"pack.json": "["}, "pack.json: invalid json"),
    ],
)
def test_a_refused_pack_leaves_nothing_behind(more, text, sources, tmp_path, capsys):
    files = {k: v for k, v in ({"pack.json": about()} | sources | more).items() if v is not None}
    assert run(zipped(tmp_path / "x.zip", files), "--trust") == 2
    assert text in capsys.readouterr().err
    left = [f for f in (tmp_path / "cache").rglob("*") if f.is_file()]
    assert left == [] or "sources alone" in text


def test_what_a_killed_process_has_left_is_removed(tmp_path, sources):
    """Half an unpacked file of up to 4 GiB, but not one that another process unpacks now."""
    for name, age in ((".new_old", 2 * packed._ABANDONED), (".new_now", 0.0)):
        (folder := tmp_path / "cache/packs" / name / "new").mkdir(parents=True)
        (folder / "x").write_text("x")
        os.utime(folder.parent, (folder.stat().st_mtime - age,) * 2)
    packed.opened(zipped(tmp_path / "x.zip", {"pack.json": about()} | sources))
    assert [f.name for f in (tmp_path / "cache/packs").glob(".new_*")] == [".new_now"]


@pytest.mark.parametrize("words", [["run"], ["linearise"], ["steady"], ["study"]])
def test_verbs_that_take_no_pack_say_what_it_is(words, sources, tmp_path, capsys):
    file = zipped(tmp_path / "x.softrig.zip", {"pack.json": about()} | sources)
    assert main([*words, str(file)]) == 2
    assert "pack" in (printed := capsys.readouterr().err), printed
    assert NAME not in sys.modules


def test_a_list_of_entries_is_limited_before_it_is_read(tmp_path):
    file = zipped(tmp_path / "x.zip", {"pack.json": about()})
    data = bytearray(file.read_bytes())
    at = data.rindex(b"PK\x05\x06")
    data[at + 12 : at + 16] = (packed.FILES * packed.HEAD + 1).to_bytes(4, "little")
    file.write_bytes(data)
    with pytest.raises(ScenarioError, match="its list of files is 5120001 bytes long, expected at most 5120000"):
        packed.unpack(file, tmp_path / "new")


def test_code_that_would_run_is_listed_by_its_true_name(sources, tmp_path):
    fmu = zipped(tmp_path / "m.fmu", {"modelDescription.xml": "x", "binaries/linux64/m\u202eos.so": "x"})
    files = {"pack.json": about(), "scenario/0a/\u043cotor.dat": fmu.read_bytes()} | sources
    files[f"packages/{NAME}/{NAME}/fast.so"] = b"\x7fELF"
    folder = packed.opened(zipped(tmp_path / "x.zip", files))
    lines = list(cargo.cargo_of(folder, packed.about(folder)))
    assert lines[0].startswith(f"package {NAME} 0.0.1: 11 files, ")
    assert f"machine code {NAME}/fast.so, sha256 " in lines[0]
    digest = packed.digest_of(fmu)[:16]
    assert lines[1] == rf"FMU scenario/0a/\u043cotor.dat: binaries/linux64/m\u202eos.so, sha256 {digest}"
    assert all(line.isascii() for line in lines)


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler: apt-get install gcc")
def test_a_node_in_c_is_code_and_looking_at_it_compiles_nothing(tmp_path, capsys, monkeypatch):
    """A compiler flag can start a program, so a scenario that names sources counts as code."""
    monkeypatch.chdir(tmp_path)
    new_native("law", tmp_path / "law", "c", "softrig")
    assert main(["run", "law/law.yaml", "--mode", "inprocess", "--no-plots", "--out", "run"]) == 0
    assert main(["pack", "run", "--out", "sound.zip"]) == 0
    touched = tmp_path / "touched"
    with zipfile.ZipFile("sound.zip") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    flags = "      flags: [-DFAST, -Iinclude]\n      header: "
    files["scenario/law.yaml"] = files["scenario/law.yaml"].replace(b"      header: ", flags.encode(), 1)
    files["pack.json"] = json.dumps(json.loads(files["pack.json"]) | {"files": {}})
    file = zipped(tmp_path / "x.zip", files)
    folder = packed.opened(file)
    (line,) = cargo.cargo_of(folder, packed.about(folder))
    source = next(folder.glob("scenario/*/law.c"))
    assert line.startswith("node law: C, ")
    assert f"{source.relative_to(folder)} (sha256 {packed.digest_of(source)[:16]})" in line
    assert line.endswith("flag -DFAST, flag -Iinclude")
    monkeypatch.setenv("CC", str(tmp_path / "cc"))
    (tmp_path / "cc").write_text(f'#!/bin/sh\ntouch {touched}\nexec gcc "$@"\n')
    (tmp_path / "cc").chmod(0o755)
    capsys.readouterr()
    assert main(["report", str(file)]) == 0
    assert "computing them needs code: law" in capsys.readouterr().err
    assert main(["draw", "plot", str(file), "--format", "svg", "--out", "pictures"]) == 0
    assert main(["pack", str(file)]) == 2
    assert run(file) == 2
    assert "its code runs only when somebody confirms it" in capsys.readouterr().err
    assert not touched.exists()
    assert run(file, "--trust") == 0
    assert touched.exists()


def with_law(tmp_path, sources, **law):
    """Return the code of a pack that has a node in C, or one with the entry `link`."""
    name = f"scenario/{NAME}.yaml"
    scenario = yaml.safe_load(sources[name])
    parameters = {"sources": ["law.c"], "header": "law.h", "flags": law.pop("flags", [])}
    scenario["nodes"]["law"] = {"package": "softrig_control", "executable": "c_controller", "parameters": parameters}
    scenario["nodes"]["law"] |= law
    files = {"pack.json": about()} | sources | {name: yaml.safe_dump(scenario), "scenario/include/law.h": ""}
    folder = packed.opened(zipped(tmp_path / "x.zip", files))
    return list(cargo.cargo_of(folder, packed.about(folder)))


REACHING = [
    "-wrapper", "sh,-c,id", "@/etc/passwd", "-include", "-include/etc/passwd", "-imacros/x", "-I", "-I/etc", "-I../..",
    "-Iinclude/../../..", "-isystem/etc", "-iquote/etc", "-B/tmp/x", "-B.", "-L/tmp", "-l:x.so", "-lx", "-fplugin=x.so",
    "-fplugin", "-fplugin-arg-x-y", "-fprofile-use=/etc", "-fdump-tree-all=/etc/x", "-fauto-profile=x", "-specs=x",
    "--specs=x", "-Wl,-rpath,/tmp", "-Wa,@x", "-Wp,-MD,/etc/x", "-Xlinker", "-Xassembler", "-o", "-o/etc/x", "-MD",
    "-MF/etc/x", "-x", "-E", "--sysroot=/tmp", "-isysroot/tmp", "-save-temps", "-T/tmp/x.ld", "law.c", "/etc/passwd",
    "", "-O2 -include x", "-O2\n@x", "-D", "-std=c99/../x", "-march=native,x", "-ftest-coverage", "-iplugindir=/tmp",
]  # fmt: skip


@pytest.mark.parametrize("flag", REACHING)
def test_flags_that_reach_out_of_a_pack_are_refused(flag, sources, tmp_path):
    with pytest.raises(ScenarioError, match=r"^node law: flag .* may read or start what is not in the pack"):
        with_law(tmp_path, sources, flags=["-O2", flag])


def test_flags_that_stay_in_a_pack_are_listed(sources, tmp_path):
    flags = ['-DNAME="a b"', "-DREAL=float", "-UNDEBUG", "-O3", "-Ofast", "-std=gnu++17", "-Iinclude", "-Wall", "-g1"]
    flags += ["-Wno-unused", "-Werror=format", "-march=x86-64-v3", "-msse2", "-ffp-contract=off", "-fno-builtin", "-lm"]
    assert with_law(tmp_path, sources, flags=flags)[-1].endswith(", ".join(f"flag {flag}" for flag in flags))


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler: apt-get install gcc")
def test_looking_at_a_folder_compiles_nothing_of_it(tmp_path, capsys, monkeypatch):
    """The scenario may have come with the folder; units and plots are those of its metrics.json and of the scenario."""
    monkeypatch.chdir(tmp_path)
    new_native("law", tmp_path / "law", "c", "softrig")
    assert main(["run", "law/law.yaml", "--mode", "inprocess", "--no-plots", "--out", "run"]) == 0
    (tmp_path / "law/law.yaml").write_text(
        (tmp_path / "law/law.yaml").read_text().replace("      header: ", "      flags: [-DX=1]\n      header: ", 1)
    )
    monkeypatch.setattr(build, "_ran", lambda *_: pytest.fail("a compiler was started"))
    assert main(["draw", "plot", "run", "--format", "svg", "--out", "pictures"]) == 0
    assert main(["draw", "plot", "run/bag", "--format", "svg", "--out", "pictures"]) == 0
    assert main(["report", "run"]) == 0
    assert "without its rig" not in capsys.readouterr().err
    pictures = list((tmp_path / "pictures").glob("*.svg"))
    assert pictures
    assert "rad/s" in "".join(p.read_text() for p in pictures)


@pytest.mark.parametrize(
    ("port", "firmware"),
    [("program:/bin/true", "x"), ("qemu:../../x.elf", "x"), ("/dev/ttyACM0", "/etc"), ("simavr:x", "../..")],
)
def test_a_board_whose_files_are_not_in_the_pack_is_refused(port, firmware, sources, tmp_path):
    with pytest.raises(ScenarioError, match=r"node law links .*, a file outside of the pack"):
        with_law(tmp_path, sources, link={"port": port, "firmware": firmware})


@pytest.mark.parametrize("port", ["program:include/law.h", "/dev/ttyACM0"])
def test_a_board_in_a_pack_is_listed(port, sources, tmp_path):
    name = f"scenario/{NAME}.yaml"
    scenario = yaml.safe_load(sources[name])
    node = next(iter(scenario["nodes"]))
    scenario["nodes"][node]["link"] = {"port": port, "firmware": "x"}
    text = yaml.safe_dump(scenario)
    folder = packed.opened(zipped(tmp_path / "x.zip", {"pack.json": about()} | sources | {name: text}))
    assert list(cargo.cargo_of(folder, packed.about(folder)))[-1] == f"node {node}: a board at {port}"


@pytest.mark.parametrize("listed", [True, False])
def test_a_package_needs_no_setup_cfg(listed, sources, tmp_path, capsys, monkeypatch):
    """For an older file without it the executables are unknown, which is reported."""
    monkeypatch.chdir(tmp_path)
    points = {line.split(" = ")[0].strip(): line.split(" = ")[1] for line in sources[SETUP].splitlines() if ":" in line}
    offers = {NAME: {"console_scripts": points}} if listed else {}
    files = {"pack.json": about(offers=offers)} | {k: v for k, v in sources.items() if k != SETUP}
    # A pack without a bag has no run to repeat.
    assert run(zipped(tmp_path / "x.zip", files), "--trust") == (1 if listed else 2)
    assert (f"package {NAME} has no executable" in capsys.readouterr().err) is not listed


def test_an_installed_package_runs_in_place_of_the_packed_one(sources, tmp_path, monkeypatch):
    monkeypatch.setattr(cargo, "_is_rig_package", lambda name: name == NAME)
    folder = packed.opened(zipped(tmp_path / "x.zip", {"pack.json": about()} | sources))
    result = cargo.cargo_of(folder, packed.about(folder))
    assert (result.packages, result.kept_out, bool(result)) == ((), (NAME,), False)


def test_entry_points_and_data_files_are_laid_out_from_the_parsed_files(sources, tmp_path):
    offers = {NAME: {"console_scripts": {"tool": f"{NAME}.plant:tool"}}}
    files = {"pack.json": about(offers=offers)} | sources
    folder = packed.opened(zipped(tmp_path / "x.zip", files))
    (package,) = cargo.cargo_of(folder, packed.about(folder)).packages
    assert package.offers == offers[NAME]  # the entry points are read from the pack, not from setup.cfg
    assert sorted(package.share) == [f"share/{NAME}/package.xml", f"share/{NAME}/scenarios/{NAME}.yaml"]
    brought.add_packages("0a", [package])
    prefix = Path(os.environ["AMENT_PREFIX_PATH"].split(os.pathsep)[-1])
    assert sorted(str(f.relative_to(prefix)) for f in prefix.rglob("*") if f.is_file() and "python" not in f.parts) == [
        f"lib/{NAME}/tool",
        f"share/ament_index/resource_index/packages/{NAME}",
        f"share/{NAME}/package.xml",
        f"share/{NAME}/scenarios/{NAME}.yaml",
    ]
    assert {f.name for f in (prefix / "python").iterdir()} == {NAME, f"{NAME}-0.0.1.dist-info"}
    assert sys.path[-1] == str(prefix / "python") == os.environ["PYTHONPATH"].split(os.pathsep)[-1]


# figures --------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sent(tmp_path_factory):
    """A pack of a run of softrig's own blocks, by place."""
    folder = tmp_path_factory.mktemp("sent")
    (folder / "mine.yaml").write_text("title: Mine\nextends: dc_motor_smc_b2\nduration: 0.2\n")
    assert main(["run", str(folder / "mine.yaml"), "--mode", "inprocess", "--no-plots", "--out", f"{folder}/run"]) == 0
    assert main(["pack", f"{folder}/run", "--out", f"{folder}/x.zip"]) == 0
    with zipfile.ZipFile(folder / "x.zip") as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def forged(sent, place, change):
    """The same with one file changed, and the manifest adapted."""
    content = {**sent, place: change(sent[place].decode()).encode()}
    text = json.loads(content["pack.json"]) | {"files": {}}
    return content | {"pack.json": json.dumps(text)}


def first_figure(text):
    content = json.loads(text)
    content["metrics"][0]["value"] = 0.125
    return json.dumps(content)


def other_run(text):
    content = json.loads(text)
    return json.dumps(content | {"run": content["run"][::-1]})


@pytest.mark.parametrize(
    ("place", "change", "text"),
    [
        (None, None, None),
        ("metrics.json", first_figure, "0.125 in metrics.json, the bag gives "),
        ("metrics.json", other_run, "they do not belong together"),
        ("scenario/mine.yaml", lambda t: t.replace("delta: 5.0", "delta: 5.5"), "its scenario is not that of its run"),
    ],
)
def test_figures_are_computed_and_inconsistencies_reported(place, change, text, sent, tmp_path, capsys):
    files = sent if place is None else forged(sent, place, change)
    file = zipped(tmp_path / "x.zip", files)
    assert main(["report", str(file), "--out", str(tmp_path / "report.html")]) == 0
    printed, page = capsys.readouterr().err, (tmp_path / "report.html").read_text()
    assert printed == "" if text is None else text in printed
    assert ("Contradiction: " in page) is (text is not None)
    status = run(file, out=str(tmp_path / "again"))
    last = capsys.readouterr().err.splitlines()
    assert status == (1 if place == "scenario/mine.yaml" else 0)
    assert text is None or any(text in line for line in last)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda t: "[" * 100_000, "metrics.json: not valid JSON: nested too deeply"),
        (lambda t: "{}", "metrics.json: scenario: field required"),
    ],
)
def test_metrics_that_cannot_be_read_are_listed_beside_the_result(change, text, sent, tmp_path, capsys):
    """The run is repeated all the same: its numbers are compared with the bag."""
    file = zipped(tmp_path / "x.zip", forged(sent, "metrics.json", change))
    assert main(["report", str(file), "--out", str(tmp_path / "r.html")]) == 2
    assert f"x.zip: {text}" in capsys.readouterr().err
    assert run(file, out=str(tmp_path / "again")) == 0
    printed = capsys.readouterr().err.splitlines()
    assert f"x.zip: {text}" in printed[-2]
    assert "number for number" in printed[-1]


def test_control_characters_of_a_scenario_are_refused_by_their_line(sent, tmp_path, capsys):
    """A terminal obeys them, and a picture with them is no XML."""
    change = "title: Speed, true"
    files = forged(sent, "scenario/mine.yaml", lambda t: t.replace(change, 'title: "\\e[31m" #'))
    assert main(["report", str(zipped(tmp_path / "x.zip", files))]) == 2
    assert "mine.yaml: not valid YAML: line " in (printed := capsys.readouterr().err)
    assert r"control character in '\x1b[31m'; remove it" in printed


def test_an_edited_figure_of_a_run_is_not_packed(sent, tmp_path, capsys, monkeypatch):
    """Nor a run whose scenario was edited, if only its bag still has the digest."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text("title: Mine\nextends: dc_motor_smc_b2\nduration: 0.2\n")
    assert main(["run", "mine.yaml", "--mode", "inprocess", "--no-plots", "--out", "run"]) == 0
    metrics = tmp_path / "run/metrics.json"
    right = metrics.read_text()
    metrics.write_text(first_figure(right))
    assert main(["pack", "run"]) == 2
    assert "run: rise_time: 0.125 in metrics.json, the bag gives none; run it again" in capsys.readouterr().err
    metrics.write_text(json.dumps({k: v for k, v in json.loads(right).items() if k != "run"}))
    assert main(["pack", "run"]) == 0
    (tmp_path / "mine.yaml").write_text("title: Mine\nextends: dc_motor_smc_b2\nduration: 0.21\n")
    assert main(["pack", "run"]) == 2
    assert "its scenario gives another duration, seed or parameters" in capsys.readouterr().err


def test_bag_and_figures_of_two_different_runs_are_refused(sent, tmp_path, capsys):
    folder = tmp_path / "run"
    (folder / "bag").mkdir(parents=True)
    for place in sent:
        if place.startswith("bag/") or place == "metrics.json":
            (folder / place).write_bytes(sent[place])
    content = json.loads(sent["metrics.json"])
    (folder / "metrics.json").write_text(json.dumps(content | {"run": content["run"][::-1]}))
    assert main(["report", str(folder), "--out", str(tmp_path / "r.html")]) == 0
    assert "they do not belong together" in capsys.readouterr().err


def test_the_digest_of_a_run_follows_from_its_bag_and_its_scenario(sent, tmp_path):
    """Each half separately, from the content of the file."""
    from softrig_bags.read import read_bag

    file = zipped(tmp_path / "x.zip", sent)
    folder = packed.opened(file)
    digest = json.loads(sent["metrics.json"])["run"]
    assert About.model_validate_json(sent["pack.json"]).run == digest
    assert recorded_half(read_bag(folder / "bag")) == bagged_half(folder / "bag") == digest[:16]
    rig = rig_of(str(folder / "scenario/mine.yaml"))
    assert asked_half(rig, 0) == digest[16:]
    assert asked_half(rig, 1) != digest[16:]


# signatures, sandbox --------------------------------------------------------------------------------------------------


@pytest.mark.skipif(shutil.which("ssh-keygen") is None, reason="no OpenSSH")
def test_a_signature_is_shown_and_one_of_other_bytes_is_refused(tmp_path, monkeypatch):
    key, file = tmp_path / "key", tmp_path / "x.zip"
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", key], check=True)
    file.write_bytes(b"some bytes")
    monkeypatch.setenv(signature.SIGNERS, str(tmp_path / "signers"))
    assert signature.signed_by(file) == "unsigned"
    signature.sign(file, key)
    assert signature.signed_by(file).startswith("signed by an unknown key, SHA256:")
    public = (tmp_path / "key.pub").read_text().split()
    (tmp_path / "signers").write_text(f"ann@example.com {public[0]} {public[1]}\n")
    assert signature.signed_by(file).startswith("signed by ann@example.com, SHA256:")
    file.write_bytes(b"other bytes")
    with pytest.raises(ScenarioError, match=r"x\.zip\.sig: .*: it does not sign x\.zip"):
        signature.signed_by(file)
    file.write_bytes(b"some bytes")
    (tmp_path / "signers").write_text("")
    with pytest.raises(ScenarioError, match="is not among the signers"):
        signature.signed_by(file)
    with pytest.raises(ScenarioError, match="--sign"):
        signature.sign(file, tmp_path / "none")


def test_a_confined_process_has_no_network_and_writes_nothing(tmp_path):
    """With harmless attempts in a separate process."""
    if why := confined.forbidden():
        pytest.skip(why)
    (tmp_path / "kept").write_text("x")
    with socket.create_server(("127.0.0.1", 0)) as server:
        code = f"""
import os, socket
from softrig_core.kit.confined import confine
confine([{str(tmp_path / "kept")!r}])
def of(work):
    try:
        return str(work())
    except OSError as error:
        return type(error).__name__
print(of(lambda: open({str(tmp_path / "kept")!r}).read()))
print(of(lambda: open({str(tmp_path / "kept")!r}, "w")))
print(of(lambda: open("/etc/softrig_try", "w")))
print(of(lambda: socket.create_connection(("127.0.0.1", {server.getsockname()[1]}), 2)))
print(os.path.exists(os.path.expanduser("~/.ssh")) or os.path.exists(os.path.expanduser("~/.bashrc")))
print(of(lambda: open("scratch", "w").write("abc")))
print(of(lambda: os.mkdir("/run/x")))
"""
        result = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=False)
    assert result.stdout.split() == ["x", "OSError", "OSError", "OSError", "False", "3", "OSError"], result


def test_missing_bubblewrap_is_reported(capsys, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert sandbox.command(argparse.Namespace()) is None
    assert "no bubblewrap here" in capsys.readouterr().err


def test_missing_namespaces_are_reported(sources, tmp_path, capsys, monkeypatch):
    fmu = zipped(tmp_path / "m.fmu", {"modelDescription.xml": "x"})
    monkeypatch.setattr(trust, "forbidden", lambda: "Operation not permitted")
    monkeypatch.setattr(trust, "need", lambda *_: None)
    files = {"pack.json": about(), "scenario/0a/m.fmu": fmu.read_bytes()} | sources
    assert run(zipped(tmp_path / "x.zip", files)) == 2
    printed = capsys.readouterr().err
    assert "the system allows no namespaces (Operation not permitted): an FMU runs with all your rights" in printed


@pytest.mark.long
@pytest.mark.skipif(shutil.which("bwrap") is None, reason="no bubblewrap")
def test_in_bubblewrap_a_confirmed_package_writes_only_its_results(sources, tmp_path, monkeypatch):
    """In a separate process: the module tries to write beside its results and to reach one of our ports."""
    plant, touched = f"packages/{NAME}/{NAME}/plant.py", tmp_path / "touched"
    tries = (
        "import contextlib, socket\nwith contextlib.suppress(OSError):\n"
        f"    open({str(touched)!r}, 'w')\nwith contextlib.suppress(OSError):\n"
        "    socket.create_connection(('127.0.0.1', {port}), 1)\n    raise SystemExit('reached')\n"
    )
    monkeypatch.chdir(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as server:
        text = sources[plant] + tries.replace("{port}", str(server.getsockname()[1]))
        file = zipped(tmp_path / "x.zip", {"pack.json": about()} | sources | {plant: text})
        words = ["run", "--like", str(file), "--mode", "inprocess", "--no-plots", "--out", "again", "--trust"]
        made = subprocess.run(
            [sys.executable, "-P", "-m", "softrig_bringup", *words], capture_output=True, text=True, check=False
        )
    if "bubblewrap does not work here" in made.stderr:
        pytest.skip(made.stderr)
    assert made.returncode == 1, made.stderr  # a pack without a bag has no run to repeat
    assert "it runs in bubblewrap" in made.stderr
    assert "reached" not in made.stderr
    assert (tmp_path / "again/metrics.json").is_file()
    assert not touched.exists()
