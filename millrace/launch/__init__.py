"""Launchers: each starts a learner and workers on one machine or on a cluster. Learner and workers do not import them."""
