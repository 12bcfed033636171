"""Logging on both sides: how many lines a peer may cause, and notices, which aren't warnings."""
