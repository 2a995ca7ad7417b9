"""The verbs of the command line: each module has the function that runs a verb, and returns its exit status."""
