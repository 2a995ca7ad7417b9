"""What `colcon test` runs of this package alone; the tests of the suite are in tests/ of the repository."""

import pytest
from softrig_core.rig.package_check import LINTERS, check_entry_point, entry_points, lint


@pytest.mark.parametrize("point", entry_points("softrig_nodes"), ids=lambda p: p.name)
def test_what_the_package_offers_is_there_and_starts(point):
    left = check_entry_point(point)
    if left:
        pytest.skip(left)


@pytest.mark.parametrize("linter", LINTERS)
def test_a_linter_of_ament_accepts_the_package(linter):
    status = lint(linter, "softrig_nodes")
    if status is None:
        pytest.skip("it is not installed")
    assert status == 0
