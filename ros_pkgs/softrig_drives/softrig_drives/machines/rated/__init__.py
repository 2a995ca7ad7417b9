"""From the rated values of a data sheet to a drive: what follows, what has to be assumed, and what cannot be."""
