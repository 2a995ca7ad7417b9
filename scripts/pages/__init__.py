"""What makes the doc pages, and holds them to the code: ``scripts/softrig pages``, from a checkout."""
