"""A rig that runs in this process: live, or fed by a recording."""
