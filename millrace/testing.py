"""Tests for user code. `check_algorithm` finds mistakes in an algorithm; use it with pytest or by itself.

>>> from millrace.algorithms import PPO
>>> from millrace.testing import check_algorithm
>>> check_algorithm(PPO, rollout_steps=8, learns=False)
"""

from __future__ import annotations

from typing import Any

from millrace.protocol.errors import MillraceError

__all__ = ["AlgorithmMistakes", "check_algorithm"]


class AlgorithmMistakes(MillraceError, AssertionError):
    """An algorithm breaks the rules of `millrace.algorithms.Algorithm`. The message has a line for each mistake."""

    def __init__(self, name: str, mistakes: list[str]) -> None:
        super().__init__("\n".join(f"{name}: {mistake}" for mistake in mistakes))
        self.mistakes = mistakes
        """The mistakes, each in one line."""


def check_algorithm(algorithm: type, *, learns: bool = True, **settings: Any) -> None:
    """Check that a class follows the rules of `millrace.algorithms.Algorithm`, in this process.

    This takes about 5 s of CPU time for a subclass of PPO or SAC, and 40 s for one of Rainbow. To save time, hidden layers
    have at most 32 units and `learning_starts` is at most 100, unless you pass `net`, `critic_net` or `learning_starts`.

    The class learns from batches of a toy environment, with 2 lanes of 4 env copies and rollouts of `rollout_steps` steps
    (at most 64). The checks are that

    - `Config`, the methods, and the shapes and dtypes of weights and metrics follow the rules;
    - `update` calls `pulse`, changes no array of the batch, and learns nothing from rows that are not valid;
    - the same seed and batches give the same bits, whatever the state of the global random number generators;
    - a new object into which a saved state was loaded continues with the same bits;
    - `roll_back` restores everything, even after an update that stopped halfway;
    - a loss that is not finite raises an error;
    - the algorithm learns the identity environment, where the right action equals the observation.

    Arguments:
        algorithm: The class.
        learns: Whether to make the last check, whose duration depends on how fast the algorithm learns.
        **settings: Settings of the algorithm, by name, that replace its defaults.

    Raises `AlgorithmMistakes`, which is an AssertionError, with one line for each mistake.
    """
    from millrace.learner.algorithm_check.mistakes import mistakes

    if found := list(mistakes(algorithm, settings, learns=learns)):
        raise AlgorithmMistakes(algorithm.__name__, found)
