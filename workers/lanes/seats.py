"""The state of the seats of a lane's env copies from step to step: who acts, who waits, and the actions of those who wait.

Rule: a seat's row is the one in which its outcome arrives (`millrace.protocol.envs.seats`). Until then each row repeats what
was written when the seat acted: action, log-probability, and the state of the policy before it. So the row is complete
wherever rollouts are cut, and a rollout may contain an action that older weights chose, with its log-probability under them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from millrace.protocol.arrays import Array, Bools, Floats
from millrace.protocol.policy.recurrent import zero_state
from millrace.protocol.specs import PolicySpec
from millrace.workers.copies.env_copies import SeatColumns


class Seats:
    """The seats of N copies, N · A columns."""

    def __init__(self, policy: PolicySpec, columns: int) -> None:
        self.acts: Bools = np.zeros(columns, bool)
        """[N · A] whether the next step takes the seat's action"""
        self._waits = np.zeros(columns, bool)  # [N · A] whether it has acted, and its row is not complete
        self._held: list[Array] = []  # what the policy wrote when each seat last acted
        self._held_state = zero_state(policy, columns)  # [N · A, S] the policy's state before that

    def memory(self) -> tuple[Array, ...]:
        """The state that `recall` needs: who waits, the policy's states before they acted, and the rows written then."""
        return (self._waits.copy(), self._held_state.copy(), *(held.copy() for held in self._held))

    def recall(self, memory: Sequence[Array], columns: Sequence[int]) -> None:
        """Take over, for these columns, the `memory` of other seats."""
        waits, held_state, *held = memory
        self._waits[columns] = waits[columns]
        self._held_state[columns] = held_state[columns]
        self._held = [np.zeros_like(array) for array in held]
        for mine, array in zip(self._held, held, strict=True):
            mine[columns] = array[columns]

    def state_before(self, state: Floats) -> Floats:
        """The state before the first of the next rows, if the policy is in this state [N · A, S] now."""
        return np.where(self._waits[:, None], self._held_state, state)

    def acted(self, t: int, written: Sequence[Array], before: Floats, state: Floats) -> None:
        """Take the policy's row t, written for all columns from the state `before`. Only some seats act."""
        if not self._held:
            self._held = [np.zeros_like(array[0]) for array in written]
        for array, held in zip(written, self._held, strict=True):
            held[self.acts] = array[t][self.acts]
            array[t] = held
        self._held_state[self.acts] = before[self.acts]
        state[~self.acts] = before[~self.acts]
        self._waits |= self.acts

    def stepped(self, columns: SeatColumns) -> None:
        """Take the result of a step."""
        self._waits &= ~columns.complete
        self.acts = columns.acts
