"""Callbacks: the user's code that a run calls between its steps."""
