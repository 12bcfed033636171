"""Cloning: the start of a policy from demonstrations."""
