"""Environments as both sides describe them: spaces, and the vectorized forms."""
