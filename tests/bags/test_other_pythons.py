"""Golden bags under every CPython that softrig supports and this machine has: each in a set-up of its own."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
VERSIONS = ("3.11", "3.12", "3.13", "3.14")


def python(version):
    """Return a CPython of this version, of the machine or of pyenv; None if there is none."""
    versions = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    for candidate in (f"python{version}", *sorted(versions.glob(f"{version}.*/bin/python{version}"))):
        if result := shutil.which(candidate):  # pyenv may have a shim for a version that is not active
            asked = subprocess.run(
                [result, "-c", "import ensurepip, sys, venv; print(sys.version)"], capture_output=True, text=True
            )
            if asked.returncode == 0 and asked.stdout.startswith(f"{version}."):
                return result
    return None


@pytest.mark.long
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("version", VERSIONS)
def test_golden_bags_under_another_python(version, tmp_path):
    if f"{sys.version_info.major}.{sys.version_info.minor}" == version:
        pytest.skip(f"CPython {version} is the one of all other tests")
    if not (of := python(version)):
        pytest.skip(f"no CPython {version} here")
    checkout = tmp_path / "checkout"
    subprocess.run(["git", "clone", "-q", "--shared", ROOT, checkout], check=True)
    keep = {"HOME", "PATH", "XDG_CACHE_HOME", "SOFTRIG_WHEELS", "LANG"} | {
        n for n in os.environ if "CERT" in n or n.startswith(("PIP_", "UV_"))
    }
    environment = {name: value for name, value in os.environ.items() if name in keep}
    environment |= {"SOFTRIG_PYTHON": of, "SOFTRIG_WORKSPACE": "none"}
    environment["PATH"] = environment["PATH"].replace(f"{ROOT}/.venv/bin:", "")
    done = subprocess.run([checkout / "scripts" / "softrig", "check", "--golden"], env=environment, cwd=checkout,
                          capture_output=True, text=True)  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    *rigs, machine = done.stdout.splitlines()
    assert f"CPython {version}." in machine
    assert len(rigs) == len(list((ROOT / "bags").glob("*/golden.yaml")))
    if "the same functions and packages" in machine:  # otherwise each bag was compared with its own tolerances
        assert [rig for rig in rigs if not re.search(r"agrees byte for byte$", rig)] == []
