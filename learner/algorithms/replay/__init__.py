"""The replay buffer: where off-policy algorithms keep transitions, and how they draw them."""
