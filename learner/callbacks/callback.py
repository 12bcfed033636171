"""The base of a user's callbacks: the moments of a run at which it calls them.

Rule: a callback runs in the learner's process and thread, between two steps of the run, so the run waits for it. Workers
may already collect the next rollouts meanwhile.
"""

from __future__ import annotations

from millrace.learner.run_folder.progress import Progress


class Callback:
    """Your own code that a run calls. Write the methods that you need; the others cost nothing.

    Each method gets a `Progress`. If it returns False, the run ends as if all steps were done: with a checkpoint, the final
    evaluation and a summary. If it raises, the run ends too: the state after the last complete update is saved, then the
    exception is raised. If a method returns anything else, the run continues.

    >>> import millrace
    >>> class StopWhenGood(millrace.Callback):
    ...     def on_update(self, progress):
    ...         return progress.return_mean is None or progress.return_mean < 10
    >>> run = millrace.train("CartPole-v1", callbacks=[StopWhenGood()], workers=1, eval_episodes=2, progress=False)
    >>> run.summary.env_steps < 5_000
    True
    """

    def on_start(self, progress: Progress) -> object:
        """The run begins, or is resumed (then `progress.updates` isn't 0): workers have joined, no rollout was collected."""
        return None

    def on_rollouts(self, progress: Progress) -> object:
        """`progress.rollouts` have arrived, and the next update will use them. Their arrays are read-only.

        Not called if an earlier callback has ended the run.
        """
        return None

    def on_update(self, progress: Progress) -> object:
        """An update was made, and its weights were sent. Its row of metrics is written."""
        return None

    def on_evaluation(self, progress: Progress) -> object:
        """The policy was evaluated: `progress.evaluation`. Also called for the evaluation of the final policy."""
        return None

    def on_checkpoint(self, progress: Progress) -> object:
        """A checkpoint was written: `progress.checkpoint`. The policy is saved beside it, in the run folder."""
        return None

    def on_end(self, progress: Progress) -> object:
        """The run has ended: `progress.stop_reason`. It is called once if `on_start` was called, also after an error."""
        return None
