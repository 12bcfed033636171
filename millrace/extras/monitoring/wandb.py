"""Logs a run to Weights & Biases: its settings, metrics and evaluations. A resumed run continues under the same id."""

from __future__ import annotations

import re
from typing import Any

from millrace import Progress
from millrace.extras.monitoring.run_rows import RowCallback, flat_settings, run_name, tool
from millrace.learner.run_folder.progress import ENV_STEPS_KEY


class WandbCallback(RowCallback):
    """Logs a run to Weights & Biases (`pip install wandb`).

    ```python
    import millrace
    from millrace.extras.monitoring.wandb import WandbCallback

    run = millrace.train("CartPole-v1", callbacks=[WandbCallback(project="cartpole", mode="offline")])
    ```
    """

    def __init__(self, every_s: float = 1.0, **init: Any) -> None:
        """`every_s`: minimum number of seconds between two rows. `init`: keyword arguments for `wandb.init`.

        Raises `UsageError` if wandb is not installed.
        """
        super().__init__("wandb", every_s)
        self._wandb = tool("wandb")
        self._init = init
        self._run: Any = None

    def _begin(self, progress: Progress) -> None:
        name = run_name(progress)
        same = {"id": re.sub(r"[^\w.-]", "-", name)[:128], "name": name, "resume": "allow"}
        self._run = self._wandb.init(**{**same, "config": flat_settings(progress), "dir": progress.run, **self._init})
        self._run.define_metric(ENV_STEPS_KEY)
        self._run.define_metric("*", step_metric=ENV_STEPS_KEY)

    def _end(self, progress: Progress) -> None:
        if self._run is None:
            return
        self._log(self._rows.last(progress), progress)
        self._run.summary["stop_reason"] = progress.stop_reason
        self._run.finish(exit_code=int(progress.cut_short))

    def _send(self, row: dict[str, float], progress: Progress) -> None:
        self._run.log({**row, ENV_STEPS_KEY: progress.env_steps})
