"""Launchers: where a run's processes are placed. Thin: each composes the learner and the workers, which know nothing of it."""
