"""Rigs as native code: the blocks' own text, specialised to their parameters, compiled as one function a rig."""
