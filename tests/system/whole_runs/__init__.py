"""Runs on this machine from their start to their end: the same for any number of workers."""
