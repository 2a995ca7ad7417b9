"""Generalised unified power flow controller (GUPFC) with 48-pulse converters in the middle of a double-circuit line."""
