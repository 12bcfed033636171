"""Batches to learn from, and how far two computations of the same numbers may differ."""
