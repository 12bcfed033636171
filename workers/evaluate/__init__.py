"""Evaluating a policy: playing whole episodes on separate env copies, which don't belong to the lanes of training."""
