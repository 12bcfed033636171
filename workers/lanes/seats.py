"""The state of the seats of a lane's env copies from step to step: who acts, who waits, and the actions of those who wait.

Rule: a seat's valid row is the one in which the outcome of its action arrives (`millrace.protocol.envs.seats`). Until then,
each row repeats what was written when the seat acted: the action, its log-probability, and the state of the policy before
it. The valid row is therefore complete, wherever one rollout ends and the next begins. As a result, a rollout may contain an
action that older weights chose, with its log-probability under those weights.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from millrace.protocol.arrays import Array, Bools, Floats
from millrace.protocol.policy.recurrent import zero_state
from millrace.protocol.specs import PolicySpec
from millrace.workers.copies.env_copies import SeatColumns


class Seats:
    """The seats of N copies, which are N · A columns."""

    def __init__(self, policy: PolicySpec, columns: int) -> None:
        self.acts: Bools = np.zeros(columns, bool)
        """[N · A] whether the seat acts in the next step"""
        self.waits: Bools = np.zeros(columns, bool)
        """[N · A] whether the seat has acted, and its row is not complete yet"""
        self._held: list[Array] = []  # [N · A, …] each, what the policy wrote when each seat last acted
        self._held_state = zero_state(policy, columns)  # [N · A, S] the policy's state before each seat last acted

    def memory(self) -> tuple[Array, ...]:
        """The state that `recall` needs: the policy's state before each seat acted, and what the policy then wrote."""
        return (self._held_state.copy(), *(held.copy() for held in self._held))

    def recall(self, memory: Sequence[Array], columns: Sequence[int]) -> None:
        """For these columns, restore the state from the `memory` of another lane's seats."""
        held_state, *held = memory
        self._held_state[columns] = held_state[columns]
        self._held = [np.zeros_like(array) for array in held]
        for mine, array in zip(self._held, held, strict=True):
            mine[columns] = array[columns]

    def state_before(self, state: Floats) -> Floats:
        """The policy's state [N · A, S] to send with a rollout that begins now, given its current `state`.

        For a seat that waits, it is the state before the seat acted.
        """
        return np.where(self.waits[:, None], self._held_state, state)

    def acted(self, t: int, written: Sequence[Array], before: Floats, state: Floats) -> None:
        """Correct what the policy has written for all columns at step t, because only some seats act.

        For a seat that doesn't act, row t of the arrays `written` gets the entries of the seat's last action, and `state` is
        reset to `before`.
        """
        if not self._held:
            self._held = [np.zeros_like(array[0]) for array in written]
        for array, held in zip(written, self._held, strict=True):
            held[self.acts] = array[t][self.acts]
            array[t] = held
        self._held_state[self.acts] = before[self.acts]
        state[~self.acts] = before[~self.acts]
        self.waits |= self.acts

    def stepped(self, columns: SeatColumns) -> None:
        """Record the result of a step: which rows it completes, and which seats act next."""
        self.waits &= ~columns.complete
        self.acts = columns.acts
