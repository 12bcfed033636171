"""Every number in metrics.jsonl and TensorBoard, with its label, unit and meaning. Pure.

The dashboard uses this table, and reference/metrics.md is generated from it.

Rule: every number that millrace itself logs has an entry here. In a name, `NAME` stands for a name that the user chose.
"""

from __future__ import annotations

from typing import NamedTuple


class Meaning(NamedTuple):
    """The meaning of a number that is logged."""

    unit: str
    text: str
    label: str = ""
    """label to show; if empty, it is made from the name"""


STEPS = "env steps"
EPISODES = "episodes"
SECONDS = "s"
VERSIONS = "versions"
TICKETS = "tickets"
TRANSITIONS = "env steps"
REWARD = "reward"
NONE = "–"
OWN = "Your own"

METRICS: dict[str, dict[str, Meaning]] = {
    "Training episodes": {
        "rollout/ep_rew_mean": Meaning(REWARD, "Mean return of the last 100 training episodes, in raw rewards.", "return"),
        "rollout/ep_len_mean": Meaning(STEPS, "Mean length of the same episodes.", "episode length"),
        "rollout/NAME": Meaning("its own", "Mean over the same episodes of a number of `--info-keys`."),
        "rollout/NAME_missing": Meaning(EPISODES, "How many of these episodes did not report the number."),
        "rollout/exploration_rate": Meaning(NONE, "DQN, Rainbow: probability ε of a random action."),
    },
    "Evaluations": {
        "eval/mean_reward": Meaning(REWARD, "Mean return of the greedy episodes, in raw rewards.", "return of evaluations"),
        "eval/env_steps": Meaning(STEPS, "With `--eval-workers`: env steps of the evaluated policy.", "env steps evaluated"),
        "eval/mean_ep_length": Meaning(STEPS, "Mean length of these episodes.", "episode length of evaluations"),
        "eval/NAME": Meaning("its own", "Mean over these episodes of a number of `--info-keys`."),
        "eval/NAME_missing": Meaning(EPISODES, "How many of these episodes did not report the number."),
    },
    "Self-play": {
        "self_play/elo": Meaning("Elo", "Rating of the policy, 1200 at first, by episodes against snapshots and programs."),
        "self_play/snapshots": Meaning("versions", "Earlier versions of the policy that are kept.", "snapshots"),
        "rollout/score": Meaning(NONE, "Share of the last 100 training episodes that were won; in a tie it is divided."),
        "eval/score": Meaning(
            NONE, "Share of the evaluation's episodes that were won; in a tie it is divided.", "score of evaluations"
        ),
    },
    "Progress and speed": {
        "time/total_timesteps": Meaning(STEPS, "Env steps that updates have used: the x axis of the curves.", "env steps"),
        "time/iterations": Meaning("updates", "Updates so far.", "updates"),
        "time/time_elapsed": Meaning(
            SECONDS, "Seconds of training, including those before a resume. Evaluations do not count.", "time of training"
        ),
        "time/fps": Meaning(
            "env steps/s", "Env steps for each second of training, since this process started.", "env steps per second"
        ),
    },
    "Lag": {
        "lag/mean": Meaning(VERSIONS, "Mean lag of the rollouts of the last update.", "mean lag"),
        "lag/max": Meaning(VERSIONS, "Largest lag of these rollouts.", "largest lag"),
    },
    "Tickets and transitions": {
        "ledger/issued": Meaning(TICKETS, "Tickets that were given to workers.", "tickets issued"),
        "ledger/used": Meaning(TICKETS, "Tickets whose rollout an update used.", "tickets used"),
        "ledger/outstanding": Meaning(TICKETS, "Tickets that are neither used nor given up.", "tickets outstanding"),
        "ledger/lost": Meaning(
            TICKETS, "Their worker was lost, left or sent an unusable rollout.", "tickets lost"
        ),
        "ledger/transitions_received": Meaning(TRANSITIONS, "Env steps that reached the learner."),
        "ledger/transitions_used": Meaning(TRANSITIONS, "Env steps that updates used."),
        "ledger/transitions_waiting": Meaning(TRANSITIONS, "Env steps that wait for an update."),
        "ledger/transitions_duplicate": Meaning(TRANSITIONS, "Env steps that arrived a second time. They were dropped."),
        "ledger/transitions_late": Meaning(
            TRANSITIONS, "Env steps from a worker that had been given up. They were dropped."
        ),
        "ledger/transitions_invalid": Meaning(
            TRANSITIONS, "Env steps of rollouts that broke the row format or did not fit the run. They were dropped."
        ),
        "ledger/messages_bad": Meaning("messages", "Messages that could not be read.", "messages that could not be read"),
        "ledger/late_actions": Meaning("actions", "Actions that arrived too late for a program that owns its loop."),
    },
    "Where the time goes (worker stages: all workers together)": {
        "stage/learner_wait": Meaning(SECONDS, "Time for which the learner waited for rollouts."),
        "stage/learner_update": Meaning(SECONDS, "Time in updates of the algorithm."),
        "stage/learner_evaluate": Meaning(SECONDS, "Time in evaluations."),
        "stage/learner_other": Meaning(SECONDS, "The rest of the learner's time: checkpoints, metrics, callbacks."),
        "stage/worker_open": Meaning(SECONDS, "Time in which workers made env copies and reset them at the start."),
        "stage/worker_act": Meaning(SECONDS, "Time in which workers computed actions."),
        "stage/worker_step": Meaning(SECONDS, "Time in which workers stepped env copies."),
        "stage/worker_wait": Meaning(SECONDS, "Time in which workers waited for a ticket or for weights."),
        "stage/worker_evaluate": Meaning(SECONDS, "Time in which workers played evaluations."),
    },
    "Cloning, in its own row before the first update": {
        "clone/loss": Meaning(NONE, "Loss of the cloned policy and its critic, on the whole dataset.", "loss of cloning"),
        "clone/accuracy": Meaning(NONE, "Discrete actions: fraction of the steps whose action is the most probable one."),
        "clone/mean_absolute_error": Meaning(NONE, "Box actions: error of the greedy ones; with replay, in [-1, 1]."),
    },
    "Updates: all algorithms": {
        "train/learning_rate": Meaning(NONE, "Learning rate of this update."),
        "train/n_updates": Meaning(NONE, "PPO: epochs; with replay: gradient steps; others: updates.", "learning rounds"),
        "train/grad_norm": Meaning(NONE, "Before clipping, mean over the update.", "norm of the gradient"),
    },
    "Updates: actor-critic algorithms": {
        "train/policy_gradient_loss": Meaning(NONE, "Loss of the policy. Mean over the gradient steps of the update."),
        "train/value_loss": Meaning(NONE, "Loss of the critic. Mean over the gradient steps of the update."),
        "train/entropy_loss": Meaning("nats", "Negative mean entropy of the policy."),
        "train/explained_variance": Meaning(
            NONE, "Share of the targets' variance that the critic predicted. 1: all of it."
        ),
        "train/std": Meaning(NONE, "Box actions: of the Gaussian, mean over the action's elements.", "standard deviation"),
        "train/approx_kl": Meaning("nats", "PPO: from the policy that acted, in the last epoch.", "estimated KL divergence"),
        "train/clip_fraction": Meaning(NONE, "PPO: fraction of rows whose probability ratio was outside 1 ± `clip_range`."),
        "train/clip_range": Meaning(NONE, "PPO: ε of the clipped objective in this update."),
        "train/loss": Meaning(NONE, "PPO: whole loss of the last gradient step. DQN, Rainbow: mean TD loss."),
        "train/rho": Meaning(NONE, "IMPALA: mean importance weight ρ of V-trace, clipped at 1.", "importance weight"),
        "train/rows_used": Meaning("rows", "REINFORCE: rows of whole episodes, from which the update learned."),
        "train/rows_dropped": Meaning("rows", "REINFORCE: rows of unfinished episodes. They were dropped."),
    },
    "Updates: algorithms with a replay buffer": {
        "train/q_mean": Meaning(NONE, "Mean value of the actions that were taken.", "mean value"),
        "train/critic_loss": Meaning(NONE, "Continuous actions: mean loss of the critics."),
        "train/actor_loss": Meaning(NONE, "Continuous actions: mean loss of the actor."),
        "train/ent_coef": Meaning(
            NONE, "Weight of the entropy, if scheduled; in SAC, the mean temperature α.", "entropy coefficient"
        ),
        "train/ent_coef_loss": Meaning(NONE, "Mean loss of a learned temperature α.", "loss of the entropy coefficient"),
        "train/entropy": Meaning("nats", "Mean entropy of the actions in [-1, 1], estimated from samples."),
        "train/scaled_reward": Meaning(NONE, "XQC: mean reward of a minibatch, scaled."),
        "replay/size": Meaning("transitions", "Transitions in the replay buffer.", "transitions in the replay buffer"),
        "replay/bytes": Meaning("bytes", "Memory of the replay buffer.", "memory of the replay buffer"),
        "replay/env_steps_per_gradient_step": Meaning(STEPS, "New env steps for each gradient step of this update."),
    },
    OWN: {
        "train/NAME": Meaning("its own", "A number that your own algorithm returns from `loss` or `update`."),
        "custom/NAME": Meaning("its own", "A number that a callback logs with `progress.log(\"NAME\", value)`."),
    },
}  # fmt: skip
"""The numbers in titled groups, by the names under which they are logged"""

ENTRIES = {name: (title, meaning) for title, group in METRICS.items() for name, meaning in group.items()}


def described(metric: str) -> tuple[str, Meaning]:
    """The group and the meaning of the number that is logged under this name. The name may be any text.

    The label in the meaning is never empty.
    """
    group, _, name = metric.partition("/")
    of_user = f"{group}/NAME_missing" if name.endswith("_missing") else f"{group}/NAME"
    of_anybody = OWN, Meaning(NONE, f"Logged as {metric}.")
    title, found = ENTRIES.get(metric) or ENTRIES.get(of_user) or of_anybody
    return title, found._replace(label=found.label or (name or group).replace("_", " "))


def label(metric: str) -> str:
    """The label of a number."""
    return described(metric)[1].label
