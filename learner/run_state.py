"""The state of a run: what a checkpoint holds besides the algorithm's own state, and how a resumed run reads it back."""

from __future__ import annotations

import logging
from typing import Any

import msgspec

from learner.algorithms import Algorithm
from learner.rollouts.ledger import Ledger
from learner.run_folder import checkpoint
from learner.run_folder.env_attributes import AttributesState, EnvAttributes
from learner.run_folder.episode_window import EpisodeWindow
from learner.run_folder.results import Evaluation
from learner.run_folder.run_folder import RunFolder
from protocol.bounds import Natural, Real, Seconds, Version
from protocol.errors import BadMessage, CheckpointError
from protocol.rollout import Episode

log = logging.getLogger("millrace.learner")


class RunState(msgspec.Struct, kw_only=True):
    """All counters of a run. The defaults are those of a new run."""

    version: Natural = 0
    env_steps: Natural = 0
    wall_s: Seconds = 0.0
    ledger: Ledger = msgspec.field(default_factory=Ledger)
    incarnations: list[Natural] = []
    """The next incarnation of each lane."""
    episodes: list[Episode] = []
    """Those of the `EpisodeWindow`."""
    facts: list[str] = []
    """Names of the facts of these episodes."""
    env_attributes: AttributesState = msgspec.field(default_factory=AttributesState)
    """Attributes of env copies that callbacks set."""
    best: list[Real] | None = None
    """Mean return and env steps of the best evaluation."""
    best_policy: Any = None
    """Parameters [P] and buffers of the best policy, both float32. None if there is none, or if a checkpoint of an earlier
    millrace lacks it; then the run folder has it.
    """
    newest_evaluation: Evaluation | None = None
    evaluated_version: Version = -1
    """The version that `newest_evaluation` belongs to."""
    next_evaluation: Natural = 0
    """Env steps at which the next evaluation is due; 0 if that is not known."""

    def checkpoint_content(self, algorithm: Algorithm) -> dict[str, Any]:
        """The content of a checkpoint: plain data and tensors."""
        import torch

        best = None if self.best_policy is None else [torch.from_numpy(array) for array in self.best_policy]
        past = msgspec.to_builtins(msgspec.structs.replace(self, best_policy=None))
        return {"past": past, "best_policy": best, "algorithm": algorithm.state_dict()}


def restore(folder: RunFolder, algorithm: Algorithm) -> RunState:
    """Load the newest whole checkpoint into the algorithm. Raises `CheckpointError` if there is none or it does not fit."""
    found, warnings = checkpoint.newest(folder.path)
    for line in warnings:
        log.warning("%s", line)
    try:
        state = msgspec.convert(found.state["past"], RunState)
        EnvAttributes(state.env_attributes), EpisodeWindow(state.episodes, state.facts)  # they raise for what no run has
        if (best := found.state.get("best_policy")) is not None:
            state.best_policy = tuple(array.numpy() for array in best)
        algorithm.load_state_dict(found.state["algorithm"])
    except (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RuntimeError, BadMessage) as error:
        raise CheckpointError(
            f"checkpoint {found.path}: expected the state of this configuration, got another ({error}); "
            "resume it with the settings it was made with"
        ) from error
    state.ledger.end_outstanding()
    return state
