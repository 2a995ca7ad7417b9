"""A full disk: the message names the file, and no truncated file stays."""

import errno
import os
import zipfile
from pathlib import Path

import pytest
from softrig_bringup.cli import main


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("disk") / "run"
    words = ["run", "dc_motor_smc_b2", "--mode", "inprocess", "--duration", "0.02", "--no-plots", "--out", str(folder)]
    assert main(words) == 0
    return folder


def full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class Table:
    """A writer of tables on a full disk."""

    def __init__(self, path, *_):
        Path(path).touch()

    write_table = full

    def close(self):
        pass


@pytest.mark.parametrize(
    ("words", "place", "name"),
    [
        (["new", "a_rig", "--into", "OUT"], (Path, "write_text"), "OUT/a_rig/package.xml"),
        (["pack", "RUN", "--out", "OUT/x.zip"], (zipfile.ZipFile, "open"), "OUT/x.zip"),
        pytest.param(
            ["draw", "plot", "RUN", "--out", "OUT", "--format", "pdf"],
            (Path, "write_bytes"),
            "OUT/plot_01_",
            marks=pytest.mark.long,
        ),
        (["bag", "export", "RUN/bag", "--out", "OUT"], ("softrig_bags.export", "_writer"), "OUT"),
        (["export", "c", "dc_motor_smc_b2", "dc_motor_smc", "--out", "OUT"], (Path, "write_bytes"), "OUT/"),
    ],
)
def test_a_full_disk_names_the_file_and_leaves_no_part_of_it(words, place, name, run, tmp_path, capsys, monkeypatch):
    words = [w.replace("OUT", str(tmp_path)).replace("RUN", str(run)) for w in words]
    where, what = place
    if what == "_writer":
        monkeypatch.setattr(f"{where}.{what}", Table)
    else:
        monkeypatch.setattr(where, what, full)
    assert main(words) == 3
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith(f"softrig: {name.replace('OUT', str(tmp_path))}")
    assert line.endswith(": No space left on device")
    assert [f for f in tmp_path.rglob("*") if f.is_file()] == []
