"""The resources that this machine, or the job or container on it, leaves to a process."""
