"""A control law or plant in C, C++ or Rust as a member of a rig: its struct is the state."""
