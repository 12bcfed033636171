"""The files of a run: checkpoints, metrics, policies."""
