"""Errors about bags."""

from softrig_core import ScenarioError


class BagError(ScenarioError):
    """A bag, or a selection from it, cannot be used; the text names the cause, the place and what was expected."""
