"""The execution of a node's step, in lockstep and in real time."""
