"""Logs a run to MLflow: settings as parameters, and metrics over env steps.

A resumed run continues the same MLflow run. The callback uses a client of its own, so it neither starts nor ends the active
run of the `mlflow` module.
"""

from __future__ import annotations

import re
import time
from typing import Any

from millrace import Progress
from millrace.extras.monitoring.run_rows import RowCallback, flat_settings, run_name, tool

MOST_PARAMETERS = 100  # maximum number of parameters in one request
MOST_CHARACTERS = 500  # maximum length of a parameter's value
NOT_ALLOWED = re.compile(r"[^/\w.\- :]")  # characters that MLflow refuses in a metric's name
RUN_TAG = "millrace.run"


class MlflowCallback(RowCallback):
    """Logs a run to MLflow (`pip install mlflow`).

    ```python
    import millrace
    from millrace.extras.monitoring.mlflow import MlflowCallback

    callback = MlflowCallback(experiment="cartpole", tracking_uri="sqlite:///mlflow.db")
    run = millrace.train("CartPole-v1", callbacks=[callback])
    ```
    """

    def __init__(self, experiment: str = "millrace", tracking_uri: str | None = None, every_s: float = 1.0) -> None:
        """`tracking_uri`: by default, the tracking URI of `mlflow`. `every_s`: minimum number of seconds between two rows.

        Raises `UsageError` if MLflow is not installed.
        """
        super().__init__("mlflow", every_s)
        self._mlflow = tool("mlflow")
        self._experiment = experiment
        self._uri = tracking_uri
        self._client: Any = None
        self._run = ""

    def _begin(self, progress: Progress) -> None:
        client = self._client = self._mlflow.MlflowClient(tracking_uri=self._uri)
        found = client.get_experiment_by_name(self._experiment)
        experiment = client.create_experiment(self._experiment) if found is None else found.experiment_id
        name = run_name(progress)
        same = [run for run in client.search_runs([experiment]) if run.data.tags.get(RUN_TAG) == name]
        if same:
            self._run = same[0].info.run_id
            client.update_run(self._run, status="RUNNING")
            return
        self._run = client.create_run(experiment, tags={RUN_TAG: name}, run_name=name).info.run_id
        parameters = [
            self._mlflow.entities.Param(key, str(value)[:MOST_CHARACTERS]) for key, value in flat_settings(progress).items()
        ]
        for i in range(0, len(parameters), MOST_PARAMETERS):
            client.log_batch(self._run, params=parameters[i : i + MOST_PARAMETERS])

    def _end(self, progress: Progress) -> None:
        if not self._run:
            return
        self._log(self._rows.last(progress), progress)
        self._client.set_tag(self._run, "stop_reason", progress.stop_reason)
        self._client.set_terminated(self._run, status="FAILED" if progress.cut_short else "FINISHED")

    def _send(self, row: dict[str, float], progress: Progress) -> None:
        now_ms = int(time.time() * 1000)
        named = {NOT_ALLOWED.sub("_", name): value for name, value in row.items()}
        metrics = [self._mlflow.entities.Metric(name, value, now_ms, progress.env_steps) for name, value in named.items()]
        self._client.log_batch(self._run, metrics=metrics)
