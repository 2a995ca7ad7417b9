"""The published results of the suite: every claim measured, and the page of the verdicts."""
