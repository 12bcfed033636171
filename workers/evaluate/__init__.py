"""Evaluating a policy: whole episodes on env copies of their own, apart from the lanes of training."""
