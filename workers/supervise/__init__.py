"""Supervision of workers: what they do, as their supervisor sees it, and what it tells the learner."""
