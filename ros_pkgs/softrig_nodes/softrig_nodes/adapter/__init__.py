"""What every node does with its step, in lockstep and in real time."""
