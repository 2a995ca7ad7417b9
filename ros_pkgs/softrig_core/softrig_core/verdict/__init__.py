"""A rig judged: its figures, requirements and claims."""
