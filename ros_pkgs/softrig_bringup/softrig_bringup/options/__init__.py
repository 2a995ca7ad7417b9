"""What a run was asked to be, and how to ask for it again."""
