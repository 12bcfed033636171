"""The conformance test of an algorithm: `millrace.testing.check_algorithm`."""
