"""Gradients derived by hand and steps of the optimizer, for small networks: fast, and without an autograd graph."""
