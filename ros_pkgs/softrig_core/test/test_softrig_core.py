"""What `colcon test` runs of this package alone; the tests of the suite are in tests/ of the repository."""

from softrig_core.rig.package_check import package_tests

pytest_generate_tests, test_entry_point, test_linter = package_tests("softrig_core")
