"""Evaluating a policy: playing whole episodes on separate env copies, which belong to no lane."""
