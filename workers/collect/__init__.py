"""Collecting rollouts: the env copies of a lane are stepped with the policy's actions."""
