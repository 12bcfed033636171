"""Parts of a run that a test plays in its own process."""
