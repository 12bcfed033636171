"""The files of a run: settings, checkpoints, metrics, policies, results and logs."""
