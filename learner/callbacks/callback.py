"""The base class of a user's callbacks. Its methods are the moments of a run at which callbacks are called.

Rule: a callback runs in the learner's process and thread, between two steps of the run, so the run waits for it.
Meanwhile, workers may already be collecting the next rollouts.
"""

from __future__ import annotations

from millrace.learner.run_folder.progress import Progress


class Callback:
    """Your own code that a run calls. Override the methods that you need; the others cost nothing.

    Each method gets a `Progress`. If it returns False, the run ends as if all steps were done: with a checkpoint, the final
    evaluation and a summary. If it raises, the run ends too: the state after the last complete update is saved, and then the
    exception is raised again. If it returns anything else, the run continues.

    >>> import millrace
    >>> class StopWhenGood(millrace.Callback):
    ...     def on_update(self, progress):
    ...         return progress.return_mean is None or progress.return_mean < 10
    >>> run = millrace.train("CartPole-v1", callbacks=[StopWhenGood()], workers=1, eval_episodes=2, progress=False)
    >>> run.summary.env_steps < 5_000
    True
    """

    def on_start(self, progress: Progress) -> object:
        """Called when the run begins or is resumed. If it is resumed, `progress.updates` isn't 0.

        Workers have joined, and no rollout has been collected yet.
        """
        return None

    def on_rollouts(self, progress: Progress) -> object:
        """Called when the rollouts for the next update have arrived, with these rollouts in `progress.rollouts`.

        Their arrays are read-only. Not called if an earlier callback has ended the run.
        """
        return None

    def on_update(self, progress: Progress) -> object:
        """Called after an update, when its weights have been sent and its row of metrics has been written."""
        return None

    def on_evaluation(self, progress: Progress) -> object:
        """Called after each evaluation, including the final policy's, with the result in `progress.evaluation`."""
        return None

    def on_checkpoint(self, progress: Progress) -> object:
        """Called after a checkpoint is written to `progress.checkpoint`. The run folder then has the same policy, too."""
        return None

    def on_end(self, progress: Progress) -> object:
        """Called once when the run has ended, even after an error, if `on_start` was called. See `progress.stop_reason`."""
        return None
