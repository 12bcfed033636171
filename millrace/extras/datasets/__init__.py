"""Recorded episodes: writing Minari datasets and videos, and learning from a dataset."""
