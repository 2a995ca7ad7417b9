"""What holds where nobody says anything, of the packages of systems: see `tests/core/test_defaults.py`.

Who changes a default on purpose writes the list anew:
``scripts/softrig python tests/systems/test_defaults_of_systems.py``.
"""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "core"))
from test_defaults import defaults

LIST = Path(__file__).with_name("defaults.txt")
PACKAGES = ("softrig_drives", "softrig_power", "softrig_robots", "softrig_systems")


@pytest.mark.parametrize("package", PACKAGES)
def test_no_default_of_a_system_changes_without_a_word(package):
    lines = [line for line in LIST.read_text().splitlines() if line.startswith(f"{package}.")]
    written, now = (dict(line.rsplit(" = ", 1) for line in found) for found in (lines, defaults(package)))
    known = written.keys() & now.keys()
    assert {name: now[name] for name in known} == {name: written[name] for name in known}
    assert len(known) > 0.9 * len(now)  # what is new is to be written down, too


if __name__ == "__main__":
    LIST.write_text("\n".join(line for package in PACKAGES for line in defaults(package)) + "\n")
