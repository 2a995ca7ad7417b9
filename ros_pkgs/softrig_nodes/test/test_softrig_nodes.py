"""What `colcon test` runs of this package alone; the tests of the suite are in tests/ of the repository."""

import pytest
from softrig_core.rig.package_check import check_entry_point, entry_points


@pytest.mark.parametrize("point", entry_points("softrig_nodes"), ids=lambda p: p.name)
def test_what_the_package_offers_is_there_and_starts(point):
    left = check_entry_point(point)
    if left:
        pytest.skip(left)
