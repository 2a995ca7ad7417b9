"""Output on the terminal: lists, bars, completion."""
