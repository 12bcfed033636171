"""Collecting rollouts: the env copies of a lane are stepped with the actions of the policy."""
