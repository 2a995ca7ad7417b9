"""What holds where nobody says anything, of the command line: see `tests/core/test_defaults.py`.

Who changes a default on purpose writes the list anew:
``scripts/softrig python tests/bringup/test_defaults_of_bringup.py``.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "core"))
from test_defaults import defaults

LIST = Path(__file__).with_name("defaults.txt")


def test_no_default_of_the_command_line_changes_without_a_word():
    written, now = (
        dict(line.split(" = ", 1) for line in found)
        for found in (LIST.read_text().splitlines(), defaults("softrig_bringup"))
    )
    known = written.keys() & now.keys()
    assert {name: now[name] for name in known} == {name: written[name] for name in known}
    assert len(known) > 0.9 * len(now)  # what is new is to be written down, too


if __name__ == "__main__":
    LIST.write_text("\n".join(defaults("softrig_bringup")) + "\n")
