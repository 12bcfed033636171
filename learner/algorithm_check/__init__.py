"""The check of a user's own algorithm: `millrace.testing.check_algorithm`."""
