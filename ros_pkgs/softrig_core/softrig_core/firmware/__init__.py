"""Firmware of boards: an exported node behind a link, for Arduino, Cortex-M and this machine."""
