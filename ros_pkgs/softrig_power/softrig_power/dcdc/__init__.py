"""DC/DC converters with one switch: buck and boost."""
