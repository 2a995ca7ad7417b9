"""What makes the doc pages, and holds them to the code: ``scripts/softrig docs pages``, from a checkout."""
