"""Tickets, lanes and rollouts: which worker collects what, and what has become of it."""
