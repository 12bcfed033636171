"""Logging on both sides: how many lines a peer may cause, and notices, which are no warnings."""
