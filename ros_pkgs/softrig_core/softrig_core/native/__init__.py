"""Rigs as native code: the blocks' own code, specialised to their parameters, compiled as one function per rig."""
