"""Tickets, lanes and rollouts: what each worker collects and what became of it."""
