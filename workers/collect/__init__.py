"""Rollouts: env copies of a lane, stepped with the policy's actions."""
