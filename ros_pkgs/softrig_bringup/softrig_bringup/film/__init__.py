"""Drawings on a screen: as SVG, as a film of frames, as pixels."""
