"""The two ways in which a run can fail; the command line turns each into one line and an exit status."""


class ScenarioError(ValueError):
    """Bad input: the text says what was wrong, where, and what was expected (exit status 2)."""


class RunError(RuntimeError):
    """A run broke: the text names the node and topic (exit status 3)."""
