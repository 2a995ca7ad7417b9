"""What a terminal shows: lists, bars, completion."""
