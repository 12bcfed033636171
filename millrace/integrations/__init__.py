"""Callbacks for other tools: `WandbCallback` and `MlflowCallback`. Each imports its tool when it is made."""

from __future__ import annotations

from millrace.integrations.mlflow_callback import MlflowCallback
from millrace.integrations.wandb_callback import WandbCallback

__all__ = ["MlflowCallback", "WandbCallback"]
