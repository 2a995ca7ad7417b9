"""One run from scenario to results."""
