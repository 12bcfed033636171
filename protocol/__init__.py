"""The contract: all that a worker and the learner agree on. Imports neither of them; see README.md here for the wire."""
