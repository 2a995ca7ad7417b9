"""Verbs without a room of their own, and `run`, `new`, `view`, which need rooms above theirs."""
