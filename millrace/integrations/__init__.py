"""Callbacks for other tools: `WandbCallback` and `MlflowCallback`. Each imports its tool when it is made.

>>> import millrace
>>> try:
...     callbacks = [millrace.integrations.MlflowCallback()]
... except millrace.UsageError:  # mlflow is not installed
...     callbacks = []
>>> run = millrace.train("CartPole-v1", callbacks=callbacks, steps=500, workers=1, eval_episodes=2, progress=False)
"""

from __future__ import annotations

from millrace.integrations.mlflow_callback import MlflowCallback
from millrace.integrations.wandb_callback import WandbCallback

__all__ = ["MlflowCallback", "WandbCallback"]
