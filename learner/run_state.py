"""The state of a run: what changes while it trains (`RunState`), what a checkpoint has (`SavedRun`), how it is restored.

A checkpoint also has the algorithm's own state. A resumed run restores all of it (`restore`). A new run may load a part of
another run's state (`start_from`), but only numbers, for a policy that the new run's own settings describe. Modules that the
other run folder names are not imported.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import msgspec
from msgspec import UNSET

from millrace.learner.algorithms import Algorithm
from millrace.learner.algorithms.algorithm import Start
from millrace.learner.config.config import Config
from millrace.learner.resume_checks import first_difference, policy_to_start_from
from millrace.learner.rollouts.ledger import Past
from millrace.learner.rollouts.opponent_pool import PoolState
from millrace.learner.rollouts.past_rollouts import PastRollouts, packed, unpacked
from millrace.learner.run_folder import checkpoint
from millrace.learner.run_folder.env_attributes import AttributesState, EnvAttributes
from millrace.learner.run_folder.episode_window import EpisodeWindow
from millrace.learner.run_folder.results import DecidingReturns, EvaluatedPolicy, Evaluation
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.arrays import Floats
from millrace.protocol.bounds import Natural, Real, Seconds, one_line
from millrace.protocol.errors import BadMessage, CheckpointError, UsageError
from millrace.protocol.policy.layout import buffer_layout, named_views
from millrace.protocol.rollout import Episode
from millrace.protocol.specs import PolicySpec

log = logging.getLogger("millrace.learner")

MISFITS = (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RuntimeError, MemoryError, BadMessage)
"""The exceptions that loading a state with an unexpected form may raise."""
BESIDES = {"policy": "", "critic": ", critic", "all": ", critic, optimizers"}


class RunState(msgspec.Struct, kw_only=True):
    """The counts and evaluations of a run, which are current while it trains. The defaults are a new run's values."""

    version: Past = 0
    env_steps: Past = 0
    best: tuple[Real, Natural] | None = None
    """The mean return of the best evaluation, and the env steps of its policy."""
    best_policy: Any = None
    """Parameters [P] and buffers of the best policy, both float32."""
    newest_evaluation: Evaluation | None = None
    evaluated: EvaluatedPolicy = EvaluatedPolicy()
    """The policy that `newest_evaluation` evaluated."""
    ended_with: DecidingReturns | None = None
    """The returns with which training ended; None while training continues. Later evaluations don't change them."""
    pending: EvaluatedPolicy | None = None
    """The policy that is being evaluated alongside training, if there is one."""
    pending_policy: Any = None
    """Parameters [P] and buffers of that policy, both float32."""
    opponents: PoolState = msgspec.field(default_factory=PoolState)
    """The opponents in self-play, and their ratings."""
    next_evaluation: Natural = 0
    """The env steps at which the next evaluation is due; 0 if this is not known."""


class SavedRun(msgspec.Struct, kw_only=True):
    """A run between two updates, from which a resumed run continues. The defaults are a new run's values.

    The run's objects keep their own state while it trains, and a `SavedRun` is made from them for each checkpoint.
    """

    state: RunState = msgspec.field(default_factory=RunState)
    rollouts: PastRollouts = msgspec.field(default_factory=PastRollouts)
    wall_s: Seconds = 0.0
    stages: dict[str, Real] = {}
    """The seconds in each stage, as in `Summary.stages`."""
    episodes: list[Episode] = []
    """The episodes of the `EpisodeWindow`."""
    facts: list[str] = []
    """The names of the facts of these episodes."""
    env_attributes: AttributesState = msgspec.field(default_factory=AttributesState)
    """The attributes that callbacks have set on env copies."""
    opponent_policies: Any = None
    """Parameters [n, P] and buffers [n, B] of the n snapshots among the opponents, both float32."""

    def checkpoint_content(self, algorithm: Algorithm) -> dict[str, Any]:
        """The content of a checkpoint with this state and the algorithm's state, as plain data and tensors."""
        import torch

        state = self.state
        policies = {
            "best_policy": state.best_policy,
            "pending_policy": state.pending_policy,
            "opponent_policies": self.opponent_policies,
        }
        tensors = {name: each and [torch.from_numpy(array) for array in each] for name, each in policies.items()}
        rollouts = torch.from_numpy(packed(self.rollouts).copy())
        without_policies = msgspec.structs.replace(state, best_policy=UNSET, pending_policy=UNSET)
        past = msgspec.structs.replace(self, state=without_policies, rollouts=UNSET, opponent_policies=UNSET)
        return {"past": msgspec.to_builtins(past), "rollouts": rollouts, **tensors, "algorithm": algorithm.state_dict()}


def restore(folder: RunFolder, algorithm: Algorithm) -> SavedRun:
    """Load the newest undamaged checkpoint into the algorithm. Returns the saved run.

    Raises `CheckpointError` if there is no undamaged checkpoint, or if the newest one does not fit this run.
    """
    newest = _newest(folder.path)
    found = newest.state
    try:
        saved = msgspec.convert(found["past"], SavedRun)
        EnvAttributes(saved.env_attributes), EpisodeWindow(saved.episodes, saved.facts)  # both raise for an invalid state
        saved.state.best_policy = _arrays(found["best_policy"])
        saved.state.pending_policy = _arrays(found["pending_policy"])
        saved.opponent_policies = _arrays(found["opponent_policies"])
        saved.rollouts = unpacked(PastRollouts, found["rollouts"].numpy())
        algorithm.load_state_dict(found["algorithm"])
        _check_policies(saved, algorithm.weights())
        saved.rollouts.ledger.end_outstanding()
    except MISFITS as error:
        raise CheckpointError(
            f"checkpoint {newest.path}: expected the state of this configuration, got another ({one_line(str(error))}); "
            "resume it with the settings it was made with"
        ) from error
    return saved


def _arrays(tensors: Any) -> Any:
    """The arrays of a policy in a checkpoint; None if the checkpoint has no such policy."""
    return None if tensors is None else tuple(tensor.numpy() for tensor in tensors)


def _check_policies(saved: SavedRun, own: tuple[Floats, Floats]) -> None:
    """Raise `ValueError` unless each policy that the state mentions exists and is as large as the run's `own` weights."""
    state = saved.state
    snapshots = len(state.opponents.snapshots)
    for name, policy, is_there, rows in (
        ("best_policy", state.best_policy, state.best is not None, ()),
        ("pending_policy", state.pending_policy, state.pending is not None, ()),
        ("opponent_policies", saved.opponent_policies, snapshots > 0, (snapshots,)),
    ):
        expected = [f"float32{[*rows, *each.shape]}" for each in own] if is_there else []
        got = [f"{each.dtype}{list(each.shape)}" for each in policy or ()]
        if expected != got:
            raise ValueError(f"{name}: expected {' and '.join(expected) or 'none'}, got {' and '.join(got) or 'none'}")


def start_from(config: Config, policy: PolicySpec, algorithm: Algorithm) -> str:
    """Let a new algorithm start from the run or the policy that `config.start_from` names.

    Returns a line for the log that says what was loaded from where.

    `policy` is the policy to train. Raises `UserFacingError` if the other policy doesn't fit it or cannot be read.
    """
    card, parameters, buffers = policy_to_start_from(config)
    parts = config.from_parts
    run = Path(config.start_from)
    where = f"start_from {config.start_from}"
    for name in dict.fromkeys(("observation", "action", "head", *PolicySpec.__struct_fields__)):
        both = getattr(policy, name), getattr(card.policy, name)
        if difference := first_difference(*(both if name == "observation" else ((one,) for one in both))):
            wrong = f"{name} of its policy: expected {difference[0]} as in this run, got {difference[1]}"
            raise UsageError(f"{where}: {wrong}; take the algorithm and the settings of that policy, or another one")
    whole = parts != "best" and checkpoint.has_any(run)
    if parts == "auto":
        parts = "critic" if whole and policy.stores_scaled_actions else "policy"
    if whole:
        saved = _newest(run)
        state = saved.state.get("algorithm", {})
        taken = f"policy, statistics{BESIDES[parts]}, after {saved.env_steps:,} env steps"
    elif parts in ("policy", "best"):
        state = _of_policy_alone(config, policy, parameters, buffers)
        taken = f"{'best ' * (parts == 'best')}policy"
    else:
        raise UsageError(f"{where}: from_parts {parts}: expected a run with a checkpoint, got only a policy")
    try:
        algorithm.start_from(Start(state, len(parameters), critic=parts in ("critic", "all"), optimizer=parts == "all"))
    except MISFITS as error:
        why = one_line(str(error))
        raise UsageError(f"{where}: from_parts {parts}: expected the state of {config.algo}, got another ({why})") from error
    if not algorithm.is_finite():
        raise UsageError(f"{where}: expected finite weights and statistics, got NaN or infinity; start from another run")
    return f"starts from {run} ({card.env}): {taken}"


def _of_policy_alone(config: Config, policy: PolicySpec, parameters: Floats, buffers: Floats) -> dict[str, Any]:
    """The `Start.state` if only a policy is known. The policy's statistics count as much as the new run's observations."""
    import torch

    state: dict[str, Any] = {"parameters": torch.from_numpy(parameters)}
    if policy.normalize_observations:
        named = {name: torch.from_numpy(each).double() for name, each in named_views(buffers, buffer_layout(policy)).items()}
        squares = config.steps * named["observation_std"] ** 2
        state["observations"] = {"count": config.steps, "mean": named["observation_mean"], "squares": squares}
    return state


def _newest(run: Path) -> checkpoint.Checkpoint:
    """The newest undamaged checkpoint. Logs a warning for each newer one, which is damaged. Raises `CheckpointError`."""
    newest, warnings = checkpoint.newest(run)
    for line in warnings:
        log.warning("%s", line)
    return newest
