"""The check of a user-defined algorithm, `millrace.testing.check_algorithm`."""
