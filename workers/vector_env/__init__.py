"""The worker's part of a vector environment: it steps env copies with the actions that the learner sends."""
