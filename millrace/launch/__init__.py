"""Starts a learner, with workers on this machine or elsewhere. Learner and workers don't import it."""
