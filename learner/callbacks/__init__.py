"""Callbacks: a user's own code that a run calls between its steps."""
