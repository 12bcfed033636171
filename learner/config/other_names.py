"""Setting names from other libraries that users often type here, and the names that millrace uses instead. Pure.

Rule: a setting is in `OUR_NAME` only if its values mean the same in millrace, and in `INSTEAD` if millrace has another way
to do the same. docs/how-to/moving_from.md has the other names.
"""

from __future__ import annotations

from collections.abc import Collection

from millrace.learner.config.hyperparameters import algorithms_with

OUR_NAME = {
    "total_timesteps": "steps",
    "n_envs": "envs",
    "num_envs": "envs",
    "n_steps": "rollout_steps",
    "num_steps": "rollout_steps",
    "num_workers": "workers",
    "lr": "learning_rate",
    "clip_coef": "clip_range",
    "buffer_size": "replay_size",
    "net_arch": "net",
}

INSTEAD = {
    "frame_stack": 'to stack images, take --wrappers "millrace:StackImages(n=4)"',
    "csv": "docs/how-to/callbacks.md has a callback that writes a CSV file",
    "early_stopping": "--target-return with --eval-every ends a run early",
    "policy": "the network follows from the environment's spaces, and --net sets its layers",
}


def in_place_of(name: str, known: Collection[str], *, flag: bool = False) -> str:
    """The end of an error about an unknown setting `name`. It says which name to use instead; empty if that isn't known.

    `known` are this run's settings. `flag` is True if the name was given as a flag, False if as a keyword argument.
    """
    if name in INSTEAD:
        return f"; {INSTEAD[name]}"
    if name not in OUR_NAME:
        return algorithms_with(name)
    ours = OUR_NAME[name]
    shown = f"--{ours.replace('_', '-')}" if flag else ours
    return f"; millrace calls it {shown}{'' if ours in known else algorithms_with(ours)}"
