"""Launchers: each starts a learner and workers somewhere. Learner and workers know nothing of it."""
