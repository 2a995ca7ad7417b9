"""Files that repeat a run or a study elsewhere: what is in one, whether its code may run, and who vouches for it."""
