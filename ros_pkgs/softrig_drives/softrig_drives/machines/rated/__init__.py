"""From the rated values of a data sheet to a drive: derived values, assumptions, and contradictions."""
