"""Policies that a user could have written, for CartPole-v1: each is made by a callable of this module."""

from __future__ import annotations

from typing import Any

import numpy as np

from millrace.protocol.arrays import Array

ARRAYS = {"w": (4, 2), "b": (2,)}
EXTRAS = {"log_prob": "float32", "logits": ("float32", (2,)), "side": "uint8"}


class Linear:
    """A linear softmax policy that counts the steps of each episode in its state."""

    def __init__(self, temperature: float = 1.0) -> None:
        self.temperature = temperature

    def load(self, arrays: dict[str, Array]) -> None:
        """Keep the arrays."""
        self.arrays = arrays

    def act(self, obs: Array, state: Array, rng: np.random.Generator) -> tuple[Any, Any, dict[str, Any]]:
        """Sample."""
        logits = obs @ self.arrays["w"] / self.temperature + self.arrays["b"]
        action = (logits + rng.gumbel(size=logits.shape)).argmax(-1)
        shifted = logits - logits.max(-1, keepdims=True)
        log_probs = shifted - np.log(np.exp(shifted).sum(-1, keepdims=True))
        log_prob = np.take_along_axis(log_probs, action[:, None], -1)[:, 0]
        obs[:] = np.nan  # the arrays are its own to change
        state += 1
        return action, state, {"log_prob": log_prob, "logits": logits, "side": (logits[:, 0] > 0).astype(np.uint8)}

    def act_greedy(self, obs: Array, state: Array, rng: np.random.Generator) -> tuple[Any, Any, dict[str, Any]]:
        """The best action."""
        _, state, extras = self.act(obs, state, rng)
        return extras["logits"].argmax(-1), state, extras


class Broken(Linear):
    """One that does something wrong."""

    def __init__(self, wrong: str) -> None:
        super().__init__()
        self.wrong = wrong
        if wrong == "factory raises":
            raise ValueError("no such thing")

    def load(self, arrays: dict[str, Array]) -> None:
        """Raise, perhaps."""
        if self.wrong == "load raises":
            raise KeyError("w3")
        super().load(arrays)

    def act(self, obs: Array, state: Array, rng: np.random.Generator) -> tuple[Any, Any, dict[str, Any]]:
        """Return something wrong."""
        if self.wrong == "act raises":
            raise ZeroDivisionError("of the user's")
        action, state, extras = super().act(obs, state, rng)
        match self.wrong:
            case "action shape":
                action = action[None]
            case "action dtype":
                action = action + 0.5
            case "action range":
                action = action + 2
            case "state shape":
                state = state[:, :0]
            case "extra missing":
                del extras["side"]
            case "extra unknown":
                extras["more"] = action
            case "extra shape":
                extras["logits"] = extras["logits"][:, :1]
            case "extra nan":
                extras["logits"][1] = np.nan
            case "nothing":
                return None  # type: ignore[return-value]
        return action, state, extras


def not_a_policy() -> int:
    """Something else."""
    return 3
