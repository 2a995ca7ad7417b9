"""What people of ROS find in a package: a changelog that bloom reads, a page that tells all of the launch file."""

import re
from itertools import pairwise
from pathlib import Path

import pytest
from softrig_bringup.launched import ARGUMENTS

PACKAGES = Path(__file__).parents[2] / "ros_pkgs"


@pytest.mark.parametrize("package", sorted(p.parent.name for p in PACKAGES.glob("*/package.xml")))
def test_the_changelog_has_the_form_that_bloom_reads(package):
    """The package's name between two bars, then sections of versions: what is not released, or that of package.xml."""
    lines = (PACKAGES / package / "CHANGELOG.rst").read_text().splitlines()
    title = f"Changelog for package {package}"
    assert lines[:4] == ["^" * len(title), title, "^" * len(title), ""]
    sections = [(a, b) for a, b in pairwise(lines[4:]) if b and not b.strip("-")]
    assert all(len(a) == len(b) for a, b in sections)
    version = re.search("<version>(.*)</version>", (PACKAGES / package / "package.xml").read_text())[1]
    assert f"version = {version}" in (PACKAGES / package / "setup.cfg").read_text().splitlines()
    assert re.fullmatch(rf"Forthcoming|{re.escape(version)} \(\d{{4}}-\d\d-\d\d\)", sections[0][0])
    assert any(line.startswith("* ") for line in lines)


def test_the_page_of_the_workspace_has_every_argument_of_the_launch_file_and_no_other():
    rows = re.findall(
        r"^\| (`\w+`(?:, `\w+`)*) \| .* \|$", (PACKAGES / "softrig_bringup/doc/workspace.md").read_text(), re.M
    )
    assert {name.strip(" `") for row in rows for name in row.split(",")} == set(ARGUMENTS)
