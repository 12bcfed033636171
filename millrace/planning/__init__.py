"""What to choose for an environment, and what to expect: `millrace.plan`."""
