"""The verbs of the command line that are no world of their own."""
