"""Advice about what to write or install if an environment can't be used as it is."""
