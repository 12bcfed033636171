"""Recorded episodes: Minari datasets, videos, and learning from a dataset."""
