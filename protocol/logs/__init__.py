"""What the logs of both ends have in common: how many lines a peer may cause, and lines that are no warnings."""
