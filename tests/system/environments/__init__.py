"""What users' environments are like: slow, large, masked, of their own, with a simulator; workers alone run them."""
