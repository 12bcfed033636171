"""Launchers: where a run's processes are placed. Thin: each composes a learner and workers, which know nothing of it."""
