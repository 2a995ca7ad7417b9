"""What can be wrong with a bag."""

from softrig_core import ScenarioError


class BagError(ScenarioError):
    """A bag or a choice from it that cannot be used; the text says what, where and what was expected."""
