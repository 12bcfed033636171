"""What to write, or to install, when an environment cannot be used as it is."""
