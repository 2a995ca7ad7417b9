"""A rig as processes: started, watched, ended."""
