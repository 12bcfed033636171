"""Every number that metrics.jsonl and TensorBoard show: its unit and its meaning. reference/metrics.md is made of it.

Rule: a number that millrace itself logs has an entry here. In a name, `NAME` stands for a name that the user chose.
"""

from __future__ import annotations

from typing import NamedTuple


class Meaning(NamedTuple):
    """The meaning of a number that is logged."""

    unit: str
    text: str


STEPS, EPISODES, SECONDS, VERSIONS, TICKETS, TRANSITIONS = "env steps", "episodes", "s", "versions", "tickets", "env steps"
REWARD, NONE = "reward", "–"

METRICS: dict[str, dict[str, Meaning]] = {
    "Training episodes": {
        "rollout/ep_rew_mean": Meaning(REWARD, "Mean return of the last 100 training episodes, in raw rewards."),
        "rollout/ep_len_mean": Meaning(STEPS, "Mean length of the same episodes."),
        "rollout/NAME": Meaning("its own", "Mean over the same episodes of a number of `--info-keys`."),
        "rollout/NAME_missing": Meaning(EPISODES, "How many of these episodes did not report the number."),
        "rollout/exploration_rate": Meaning(NONE, "DQN: probability ε of a random action."),
    },
    "Evaluations": {
        "eval/mean_reward": Meaning(REWARD, "Mean return of the greedy episodes of an evaluation, in raw rewards."),
        "eval/env_steps": Meaning(STEPS, "With `--eval-workers`: those of the policy that was evaluated."),
        "eval/mean_ep_length": Meaning(STEPS, "Mean length of these episodes."),
        "eval/NAME": Meaning("its own", "Mean over these episodes of a number of `--info-keys`."),
        "eval/NAME_missing": Meaning(EPISODES, "How many of these episodes did not report the number."),
    },
    "Progress and speed": {
        "time/total_timesteps": Meaning(STEPS, "Env steps that updates have used. It is the x axis of the curves."),
        "time/iterations": Meaning("updates", "Updates so far."),
        "time/time_elapsed": Meaning(
            SECONDS, "Seconds of training, those before a resume included. Evaluations do not count."
        ),
        "time/fps": Meaning("env steps/s", "Env steps for each second of training, since this process started."),
    },
    "Lag": {
        "lag/mean": Meaning(VERSIONS, "Mean lag of the rollouts of the last update."),
        "lag/max": Meaning(VERSIONS, "Largest lag of these rollouts."),
    },
    "Tickets and transitions": {
        "ledger/issued": Meaning(TICKETS, "Tickets that were given to workers."),
        "ledger/used": Meaning(TICKETS, "Tickets whose rollout an update used."),
        "ledger/outstanding": Meaning(TICKETS, "Tickets that are neither used nor given up."),
        "ledger/lost": Meaning(
            TICKETS, "Tickets whose worker was lost or left or sent an unusable rollout, or whose update failed."
        ),
        "ledger/transitions_received": Meaning(TRANSITIONS, "Env steps that reached the learner."),
        "ledger/transitions_used": Meaning(TRANSITIONS, "Env steps that updates used."),
        "ledger/transitions_waiting": Meaning(TRANSITIONS, "Env steps that wait for an update."),
        "ledger/transitions_duplicate": Meaning(TRANSITIONS, "Env steps that arrived a second time. They were dropped."),
        "ledger/transitions_late": Meaning(
            TRANSITIONS, "Env steps from a worker that had been given up, or of an update that failed. They were dropped."
        ),
        "ledger/transitions_invalid": Meaning(
            TRANSITIONS, "Env steps of rollouts that broke the row format or did not fit the run. They were dropped."
        ),
        "ledger/messages_bad": Meaning("messages", "Messages that could not be read."),
        "ledger/late_actions": Meaning("actions", "Actions that came too late for a program that owns its loop."),
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
    "Cloning, in a row of its own before the first update": {
        "clone/loss": Meaning(NONE, "Loss of the cloned policy, and of its critic if it has one, on the whole dataset."),
        "clone/accuracy": Meaning(NONE, "Discrete actions: fraction of the steps whose action is the most probable one."),
        "clone/mean_absolute_error": Meaning(NONE, "Box actions: error of the greedy ones; SAC, TD3: in [-1, 1]."),
    },
    "Updates: all algorithms": {
        "train/learning_rate": Meaning(NONE, "Learning rate of this update."),
        "train/n_updates": Meaning("–", "PPO: epochs so far. DQN, SAC, TD3: gradient steps so far. Others: updates so far."),
        "train/grad_norm": Meaning(NONE, "Norm of the gradient before it is clipped, mean over the update."),
    },
    "Updates: actor-critic algorithms": {
        "train/policy_gradient_loss": Meaning(NONE, "Loss of the policy. Mean over the gradient steps of the update."),
        "train/value_loss": Meaning(NONE, "Loss of the critic. Mean over the gradient steps of the update."),
        "train/entropy_loss": Meaning("nats", "Negative mean entropy of the policy."),
        "train/explained_variance": Meaning(
            NONE, "Share of the variance of the targets that the critic predicted. 1: all of it."
        ),
        "train/std": Meaning(NONE, "Box actions: standard deviation of the Gaussian, mean over the action's elements."),
        "train/approx_kl": Meaning("nats", "PPO: estimated KL divergence from the policy that acted, in the last epoch."),
        "train/clip_fraction": Meaning(NONE, "PPO: fraction of rows whose probability ratio was outside 1 ± `clip_range`."),
        "train/clip_range": Meaning(NONE, "PPO: ε of the clipped objective in this update."),
        "train/loss": Meaning(NONE, "PPO: whole loss of the last gradient step. DQN: mean TD loss of the update."),
        "train/rho": Meaning(NONE, "IMPALA: mean importance weight ρ of V-trace, clipped at 1."),
        "train/rows_used": Meaning("rows", "REINFORCE: rows of whole episodes, from which the update learned."),
        "train/rows_dropped": Meaning("rows", "REINFORCE: rows of unfinished episodes. They were dropped."),
    },
    "Updates: DQN, SAC, TD3": {
        "train/q_mean": Meaning(NONE, "Mean value of the actions that were taken."),
        "train/critic_loss": Meaning(NONE, "SAC, TD3: mean loss of both critics."),
        "train/actor_loss": Meaning(NONE, "SAC, TD3: mean loss of the actor."),
        "train/ent_coef": Meaning(NONE, "SAC: mean temperature α, the weight of the entropy."),
        "train/ent_coef_loss": Meaning(NONE, "SAC: mean loss of a learned temperature."),
        "train/entropy": Meaning("nats", "SAC: mean entropy of the actions in [-1, 1], estimated from samples."),
        "replay/size": Meaning("transitions", "Transitions in the replay buffer."),
        "replay/bytes": Meaning("bytes", "Memory of the replay buffer."),
        "replay/env_steps_per_gradient_step": Meaning(STEPS, "New env steps for each gradient step of this update."),
    },
    "Your own": {
        "train/NAME": Meaning("its own", "A number that your own algorithm returns from `loss` or `update`."),
        "custom/NAME": Meaning("its own", "A number that a callback logs with `progress.log(\"NAME\", value)`."),
    },
}  # fmt: skip
"""The numbers in groups, each by the name under which it is logged"""
