"""Membership of workers: how they join and leave, which keys they may use, and the log about them."""
