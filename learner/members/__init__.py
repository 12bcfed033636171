"""The workers that are connected: joining, leaving, keys, and the log about them."""
