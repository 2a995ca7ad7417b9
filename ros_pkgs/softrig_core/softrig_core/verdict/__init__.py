"""The verdict on a rig: its figures, requirements and claims."""
