"""What other systems call our settings, and what to write in place of a name that is no setting. Pure.

Rule: a name in braces is a setting of ours, with the value to write, as in Python, if there is one. The names are those of
Stable-Baselines3, CleanRL, RLlib and Sample Factory. A name that is also a setting of another algorithm of ours is that one,
unless this algorithm has the setting in braces.
"""

from __future__ import annotations

import re
from collections.abc import Collection

from millrace.learner.config.hyperparameters import algorithms_with

SAME_VALUE = {
    "steps": "total_timesteps total_steps timesteps_total num_timesteps max_timesteps train_for_env_steps",
    "envs": "n_envs num_envs",
    "workers": "num_workers num_rollout_workers num_env_runners n_workers num_cpus n_jobs",
    "learning_rate": "lr policy_lr q_lr",
    "rollout_steps": "n_steps num_steps rollout rollout_length rollout_fragment_length unroll_length train_freq",
    "batch_size": "minibatch_size sgd_minibatch_size mini_batch_size",
    "n_epochs": "update_epochs num_epochs num_sgd_iter",
    "clip_range": "clip_coef clip_param clip_eps ppo_clip_ratio",
    "ent_coef": "entropy_coeff entropy_coef exploration_loss_coeff alpha",
    "vf_coef": "vf_loss_coeff value_loss_coeff value_coef",
    "max_grad_norm": "grad_clip",
    "gae_lambda": "lambda_ gae_lam",
    "gamma": "discount discount_factor",
    "replay_size": "buffer_size replay_buffer_size memory_size",
    "learning_starts": "num_steps_sampled_before_learning_starts start_steps",
    "target_every": "target_network_frequency",
    "epsilon_start": "exploration_initial_eps start_e",
    "epsilon_end": "exploration_final_eps end_e",
    "exploration_noise": "action_noise",
    "policy_delay": "policy_frequency",
    "target_noise": "target_policy_noise policy_noise",
    "target_noise_clip": "noise_clip",
    "normalize_advantage": "norm_adv",
    "normalize_observations": "normalize_input norm_obs",
    "normalize_rewards": "norm_reward",
    "eval_episodes": "n_eval_episodes",
    "eval_every": "eval_freq eval_frequency",
    "target_return": "reward_threshold stop_reward",
    "info_keys": "info_keywords",
    "callbacks": "callback",
    "wrappers": "wrapper wrapper_class",
    "env_kwargs": "env_config env_args",
    "run_dir": "tensorboard_log log_dir logdir save_dir train_dir",
    "core_size": "lstm_cell_size lstm_hidden_size rnn_size",
    "encoder": "features_extractor_class",
    "max_lag": "max_policy_lag",
    "checkpoint_every_s": "save_every_sec",
}
"""By our name, the others' names for what takes the same values."""
OTHERWISE = {
    "env_id": "millrace takes the environment as its first argument",
    "env_name": "millrace takes the environment as its first argument",
    "policy": "the network follows from the environment's spaces; its sizes are {net=(64, 64)}",
    "policy_kwargs": "millrace calls what is in it {net=(64, 64)}, {activation='relu'}, {encoder}",
    "net_arch": "millrace calls it {net=(64, 64)}",
    "fcnet_hiddens": "millrace calls it {net=(64, 64)}",
    "hidden_sizes": "millrace calls it {net=(64, 64)}",
    "hidden_size": "millrace calls it {net=(64, 64)}",
    "activation_fn": "millrace calls it {activation='relu'}",
    "fcnet_activation": "millrace calls it {activation='relu'}",
    "use_lstm": "millrace calls it {core='lstm'}",
    "use_rnn": "millrace calls it {core='gru'}",
    "use_gae": "millrace always does; {gae_lambda=1} is without",
    "anneal_lr": "millrace calls it {learning_rate_schedule='linear'}",
    "clip_vloss": "millrace calls it {clip_range_vf=0.2}",
    "train_batch_size": "a batch has {envs} times {rollout_steps} env steps",
    "train_batch_size_per_learner": "a batch has {envs} times {rollout_steps} env steps",
    "num_minibatches": "millrace counts the rows of a minibatch: {batch_size=64}",
    "nminibatches": "millrace counts the rows of a minibatch: {batch_size=64}",
    "num_envs_per_worker": "{envs} counts the copies of all workers together",
    "num_envs_per_env_runner": "{envs} counts the copies of all workers together",
    "exploration_fraction": "millrace counts env steps: {epsilon_steps=10000}",
    "target_update_interval": "millrace counts gradient steps: {target_every=250}",
    "gradient_steps": "millrace counts them for each env step: {updates_per_step=1}",
    "verbose": "millrace shows its progress always; progress=False in Python shows none",
    "cuda": "millrace calls it {device='cuda'}",
    "num_gpus": "millrace has one learner: {device='cuda'}",
    "track": "millrace calls it {callbacks}: millrace.integrations:WandbCallback",
    "wandb": "millrace calls it {callbacks}: millrace.integrations:WandbCallback",
    "capture_video": "`millrace evaluate RUN --video` films the policy after training",
    "save_model": "millrace always does, in the run folder",
    "render_mode": "workers render nothing while they train; `millrace evaluate RUN --video` films the policy",
}
"""What to say of names whose values differ, and of those for which there is no setting."""
SAYS = {
    other: f"millrace calls it {{{ours}}}" for ours, others in SAME_VALUE.items() for other in others.split()
} | OTHERWISE
SETTING = re.compile(r"\{(\w+)(?:=([^}]+))?\}")
_NOT_IN_FLAGS = re.compile(r"[\[\]()',\s]+")
LONGEST_VALUE = 30


def in_place_of(name: str, value: object, known: Collection[str], *, flag: bool = False) -> str:
    """What to write in place of a name that is no setting, as the end of a line; empty if nothing is known of it.

    `known`: the settings of this run. `flag`: it is a flag and not a keyword argument. `value`: of it; None if it has none.
    """
    says = SAYS.get(name, "")
    missing = next((match[1] for match in SETTING.finditer(says) if match[1] not in known), "")
    if (not says or missing) and (owners := algorithms_with(name)):
        return owners
    if name not in OTHERWISE and value is not None and len(f"{value!r}") <= LONGEST_VALUE:
        says = SETTING.sub(lambda match: f"{{{match[1]}={value!r}}}", says)
    shown = SETTING.sub(lambda match: written(*match.groups(), flag=flag), says)
    return f"; {shown}{algorithms_with(missing)}" if says else ""


def written(name: str, value: str | None, *, flag: bool) -> str:
    """A setting as a flag or as a keyword argument; with its value, if there is one, which is written as in Python."""
    if flag:
        return " ".join([f"--{name.replace('_', '-')}", *_NOT_IN_FLAGS.sub(" ", value or "").split()])
    return f"{name}={value}" if value else name
