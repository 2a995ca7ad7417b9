"""Nodes in lockstep: a tick ends when all messages that are due have been exchanged."""
