"""A curriculum: CartPole with a pole that grows whenever the policy has learned to balance the shorter one.

    python examples/curriculum.py

The callback sets an attribute of every env copy, which takes effect together with the next weights. The result therefore
doesn't depend on the number of workers, and a resumed run continues with the same pole. Evaluations use the full task,
because the attribute isn't set in their env copies.
"""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv

import millrace

FULL, FIRST, GROWS = 2.0, 0.5, 0.5  # half lengths of the pole in metres; CartPole-v1 has 0.5
ENOUGH = 60.0  # mean return at which the pole grows


class GrowingPole(gymnasium.Wrapper[Any, Any, Any, Any]):
    """CartPole with a pole of half length `pole`; a new value takes effect at the next reset."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.pole = FULL

    def reset(self, **keywords: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode with a pole of the current length."""
        cart_pole = self.unwrapped
        assert isinstance(cart_pole, CartPoleEnv)
        cart_pole.length = self.pole
        cart_pole.polemass_length = cart_pole.masspole * self.pole
        return super().reset(**keywords)


def growing_pole() -> gymnasium.Env[Any, Any]:
    """The environment of this example."""
    return GrowingPole(gymnasium.make("CartPole-v1"))


class Curriculum(millrace.Callback):
    """Makes the pole longer as soon as recent episodes were good."""

    def on_start(self, progress: millrace.Progress) -> None:
        """Begin a new run with the short pole. A resumed run keeps its pole."""
        if not progress.updates:
            progress.set_env_attr("pole", FIRST)

    def on_update(self, progress: millrace.Progress) -> None:
        """Make the pole longer if the mean return of the last 100 episodes is high enough."""
        pole = progress.env_attrs["pole"]
        progress.log("pole", pole)
        if pole < FULL and (progress.return_mean or 0.0) > ENOUGH:
            progress.set_env_attr("pole", min(FULL, pole + GROWS))


def train(**settings: Any) -> millrace.Run:
    """Train with the curriculum."""
    return millrace.train(growing_pole, callbacks=[Curriculum()], **settings)


if __name__ == "__main__":
    print(train(steps=100_000, seed=1).summary)
