"""The contents of a bag: blocks of messages, their types, and their numbers as columns."""
