"""Nodes that any rig may have: sources, links and their faults, linear plants, policies, requirement monitors."""
