"""Tests for user code. `check_algorithm` finds mistakes of an algorithm; use it with pytest or by itself.

>>> from millrace.algorithms import PPO
>>> from millrace.testing import check_algorithm
>>> check_algorithm(PPO, net=(16,), rollout_steps=8, learns=False)
"""

from __future__ import annotations

from typing import Any

from millrace.protocol.errors import MillraceError

__all__ = ["AlgorithmMistakes", "check_algorithm"]


class AlgorithmMistakes(MillraceError, AssertionError):
    """An algorithm breaks rules of `millrace.algorithms.Algorithm`. The message has a line for each mistake."""

    def __init__(self, name: str, mistakes: list[str]) -> None:
        super().__init__("\n".join(f"{name}: {mistake}" for mistake in mistakes))
        self.mistakes = mistakes
        """Each mistake in one line."""


def check_algorithm(algorithm: type, *, learns: bool = True, **settings: Any) -> None:
    """Check that a class keeps the rules of `millrace.algorithms.Algorithm`. Takes seconds, in this process.

    The class learns from batches of a toy environment: 2 lanes of 4 env copies and `rollout_steps` steps, at most 64. It is
    checked that

    - `Config`, the methods, and the shapes and dtypes of weights and metrics are as they must be;
    - `update` calls `pulse`, changes no array of the batch, and learns nothing from rows that are not valid;
    - the same seed and batches give the same bits, whatever the global random numbers are;
    - a saved state that is loaded into a new object continues bit for bit;
    - `roll_back` restores everything, also after an update that stopped in the middle;
    - a loss that is not finite is raised;
    - it learns the identity environment, where the right action equals the observation.

    Arguments:
        algorithm: The class.
        learns: Whether to check the last of these, which takes longest.
        **settings: Settings of the algorithm, by name, in place of their defaults.

    Raises `AlgorithmMistakes`, which is an AssertionError, with one line for each mistake.
    """
    from millrace.learner.algorithm_check.mistakes import mistakes

    if found := list(mistakes(algorithm, settings, learns=learns)):
        raise AlgorithmMistakes(algorithm.__name__, found)
