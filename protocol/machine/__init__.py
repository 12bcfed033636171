"""The cores and the memory that a process may use, given the limits of the machine and of its job or container."""
