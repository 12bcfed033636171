"""Example programs that use millrace as a user would."""
