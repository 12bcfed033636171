"""Stepping for a vector environment: env copies are stepped with the actions that the learner sends."""
