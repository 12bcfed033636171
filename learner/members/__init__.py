"""The workers that are connected: joining, leaving, keys, and what is logged of them."""
