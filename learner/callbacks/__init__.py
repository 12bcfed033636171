"""Callbacks: user code that a run calls between its steps."""
