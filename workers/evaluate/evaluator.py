"""Plays the episodes of an Evaluate order. The result depends on the order and the weights, and on nothing else.

Rule: an order has k seeds, so k env copies are stepped together, and the policy always sees a batch [1, k · A, ...], where A
is the number of seats of a copy. A copy whose episode has ended stays in the batch and is not stepped. The copies are apart
from the lanes of training. They are opened once, and reset with a seed before each episode.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from time import perf_counter
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.envs.env_actions import action_converter_of
from millrace.protocol.envs.seats import columns_of
from millrace.protocol.envs.which_copy import EnvCopy
from millrace.protocol.errors import UsageError
from millrace.protocol.messages import Evaluate, Evaluated, Weights
from millrace.protocol.policy.called_policy import CalledPolicy
from millrace.protocol.policy.masks import stored_leaves
from millrace.protocol.policy.policy import Policy
from millrace.protocol.policy.recurrent import zero_state
from millrace.protocol.random_streams import Purpose, generator
from millrace.protocol.rollout import Episode
from millrace.protocol.specs import RunSpec
from millrace.workers.acting import acting_of
from millrace.workers.copies.env_copies import EnvCopies, Leaves, LoopedCopies, StepResult, check_spaces
from millrace.workers.copies.env_errors import CopyFailed, environment_failed
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.row_writers import ObservationWriter, write_numbers
from millrace.workers.copies.seated_copies import SeatedCopies
from millrace.workers.copies.value_checks import check_acted, check_observed, check_rewards
from millrace.workers.evaluate.episode_rows import RowSender, SendRows, as_frame
from millrace.workers.lanes.running_episodes import RunningEpisodes
from millrace.workers.opponents import KnownOpponents, Match, OtherTeams


class EvaluationCopies(EnvCopies, Protocol):
    """Env copies of which those are stepped whose episodes run; no step resets a copy."""

    count: int

    def step(self, actions: Array, pulse: Pulse, copies: Sequence[int] | None = None) -> StepResult:
        """Step these copies, with an action for each of them. The result has a row for every copy."""
        ...

    def render(self, copy: int) -> Any:
        """What the environment renders. Raises `ValueError` if it cannot."""
        ...


OpenEvaluationCopies = Callable[[RunSpec, int, str | None, Pulse], EvaluationCopies]
"""Makes this number of copies, with this render mode."""


def open_looped_copies(run: RunSpec, count: int, render_mode: str | None, pulse: Pulse) -> EvaluationCopies:
    """Copies in this process. Raises `UsageError` if the environment does not render in this mode, `rgb_array`."""
    make = partial(run.env.for_evaluation().make, render_mode)
    with warnings.catch_warnings():
        if render_mode is not None:
            warnings.simplefilter("ignore")  # gymnasium's, about a render mode that is refused below
        makes, first, keys = [make] * count, EnvCopy(evaluation=True), run.policy.critic_keys
        if run.seats:
            copies: LoopedCopies = SeatedCopies(
                makes, pulse, run.seats, run.info_keys, masked=run.masked, critic_keys=keys, first=first
            )
        else:
            copies = LoopedCopies(makes, pulse, run.facts, masked=run.masked, critic_keys=keys, first=first)
    modes = (copies.envs[0].metadata or {}).get("render_modes", [])  # None: as some environments of the old package gym
    if render_mode is not None and (copies.envs[0].render_mode != render_mode or render_mode not in modes):
        copies.close()
        raise UsageError(f"environment {run.env.id} cannot be filmed: expected it to render {render_mode}, got {modes}")
    return copies


class Evaluator:
    """Plays whole episodes. It opens env copies when they are first needed."""

    def __init__(
        self, run: RunSpec, policy: Policy | CalledPolicy, open_copies: OpenEvaluationCopies = open_looped_copies
    ) -> None:
        """`policy` must hold the weights to evaluate when `play` is called."""
        self.steps = 0
        """number of env steps made"""
        self.seconds = 0.0
        """seconds spent in `play`"""
        self._run, self._open_copies = run, open_copies
        self._acting = acting_of(run, policy)
        self._stored = stored_leaves(run)
        self._opponents = KnownOpponents(run)
        self._writer = ObservationWriter(self._stored, 1, run.seats)
        self._to_env_action = action_converter_of(run.policy)
        self._copies: dict[str | None, EvaluationCopies] = {}  # by render mode

    def play(
        self, order: Evaluate, send: SendRows, pulse: Pulse, held: Mapping[int, Weights] = MappingProxyType({})
    ) -> Evaluated:
        """Play one episode for each seed. `send` gets the rows, if the order asks for them. `held`: weights of opponents.

        `pulse` is called at every step and may raise. If it raises, or the environment does (`EnvironmentFailed`), all
        copies are closed.
        """
        began_s = perf_counter()
        try:
            while (answer := self._play(order, send, pulse, self._other_teams(order, held))) is None:
                pass  # the episodes of lost copies are played again from their seeds
            return answer
        except CopyFailed as error:
            self.close()
            raise environment_failed(None, error) from error
        except BaseException:
            self.close()
            raise
        finally:
            self.seconds += perf_counter() - began_s

    def close(self) -> None:
        """Close all copies."""
        while self._copies:
            self._copies.popitem()[1].close()

    def _play(self, order: Evaluate, send: SendRows, pulse: Pulse, others: OtherTeams | None) -> Evaluated | None:
        """The answer; None if a worker was lost, and with it copies whose episodes had not ended."""
        k, A, policy = len(order.seeds), self._run.seats_of_copy, self._run.policy
        copies = self._opened(k, "rgb_array" if order.send_frames else None, pulse)
        obs = tuple(np.empty((1, k * A, *leaf.shape), leaf.dtype) for leaf in self._stored)
        state, drawn = zero_state(policy, 1, k * A), generator(order.seeds[0], Purpose.PLAYED_ACTIONS)
        senders = [RowSender(order, n, policy, send) for n in range(k)] if order.send_rows or order.send_frames else []
        played = RunningEpisodes(self._run, k, None, order.most_steps)
        found: dict[int, Episode] = {}
        cut = [False] * k
        running, t = list(range(k)), 0
        played.begin(perf_counter())
        self._write(obs, running, copies.reset(order.seeds, pulse), 0, "first reset")
        if isinstance(copies, SeatedCopies):
            outside = copies.columns.outside[: k * A]
            check_rewards(None, outside[None], self._run.row_axes)
            played.returns += outside.reshape(k, A)
        for n, sender in enumerate(senders):
            self._observe(sender, obs, n, copies)
        while running:
            pulse()
            acts = copies.columns.acts[: k * A] if isinstance(copies, SeatedCopies) else None
            with np.errstate(all="ignore"):
                before = state if acts is None else state.copy()
                chosen = self._acting.choose(obs, state, drawn, greedy=order.greedy)
                taken = self._to_env_action(chosen).astype(policy.action.dtype, copy=others is not None)
                if acts is not None:
                    state[0][~acts] = before[0][~acts]
                    if others is not None:
                        others.act([leaf[0] for leaf in obs], acts, taken)
            self._check_acted(chosen, running, obs, t)
            if (made := self._step(copies, taken, running, t, pulse)) is None:
                return None
            step, rewards, terminated, truncated = made
            self._write(obs, running, step.leaves, t + 1, f"step {t}")
            if isinstance(copies, SeatedCopies) and t + 1 == order.most_steps:  # those that go on are cut
                self._add_pending(rewards, copies, running, t)
            is_playing = np.zeros(k, bool)
            is_playing[running] = True
            played.add(np.where(is_playing[:, None], rewards, 0.0), is_playing)
            now_s, over = perf_counter(), terminated | truncated
            for n in running:
                cut[n] = not over[n] and int(played.lengths[n]) >= order.most_steps
                if over[n] or cut[n]:
                    found[n] = played.ended(n, now_s, step.facts.get(n), others).episode
            going_on = [n for n in running if n not in found]
            for n in running if senders else ():
                self._observe(senders[n], obs, n, copies)
                acted = chosen.reshape(k, A, *chosen.shape[1:])[n] if self._run.seats else chosen[n]
                senders[n].step(acted, float(rewards[n].sum()), bool(terminated[n]), bool(truncated[n]) or cut[n])
            self.steps += len(running)
            running, t = going_on, t + 1
        return Evaluated(order.session, order.ticket, tuple(found[n] for n in range(k)), tuple(cut))

    def _step(
        self, copies: EvaluationCopies, actions: Array, running: Sequence[int], t: int, pulse: Pulse
    ) -> tuple[StepResult, Array, Array, Array] | None:
        """Step the running copies: the result, rewards [k, A], terminated and truncated [k]. None if one of them was lost.

        The environments may keep their actions, so `actions` must be a new array at each step.
        """
        rows, A = len(actions), self._run.seats_of_copy
        numbers = np.zeros(rows), np.zeros(rows, bool), np.zeros(rows, bool)
        try:
            step = copies.step(actions[self._columns(running)], pulse, running)
            if step.lost is not None and step.lost[running].any():
                return None
            write_numbers(numbers, slice(None), (step.reward[:rows], step.terminated[:rows], step.truncated[:rows]))
        except CopyFailed as error:
            raise environment_failed(None, error, f"step {t}") from error
        if (columns := step.columns) is not None:
            numbers[0][:] += columns.outside[:rows]
        check_rewards(None, numbers[0][None], self._run.row_axes, t)
        rewards, terminated, truncated = (array.reshape(-1, A) for array in numbers)
        if columns is None:
            return step, rewards, terminated[:, 0], truncated[:, 0]
        over = columns.over[: rows // A]
        return step, rewards, over, np.zeros_like(over)

    def _add_pending(self, rewards: Array, copies: SeatedCopies, running: Sequence[int], t: int) -> None:
        """Add what seats have got that wait for the move after step t to rewards [k, A]: no later step will return it."""
        pending = np.zeros_like(rewards)
        for n in running:
            pending[n] = copies.pending(n)
        check_rewards(None, pending.reshape(1, -1), self._run.row_axes, t)
        rewards += pending

    def _other_teams(self, order: Evaluate, held: Mapping[int, Weights]) -> OtherTeams | None:
        """The other teams, if the order says who plays them."""
        find = self._opponents.among(held)
        matches = [Match(team, find(number)) for team, number in zip(order.teams, order.opponents, strict=True)]
        return OtherTeams(self._run, matches, generator(order.seeds[0], Purpose.PLAYED_OPPONENTS)) if matches else None

    def _opened(self, count: int, render_mode: str | None, pulse: Pulse) -> EvaluationCopies:
        """At least this number of copies. Raises `UsageError` when their spaces are not those of the run."""
        copies = self._copies.get(render_mode)
        if copies is not None and copies.count >= count:
            return copies
        if copies is not None:
            self._copies.pop(render_mode).close()
        copies = self._copies[render_mode] = self._open_copies(self._run, count, render_mode, pulse)
        check_spaces(self._run, copies)
        return copies

    def _columns(self, copies: Sequence[int]) -> Sequence[int]:
        """The columns of the seats of these copies."""
        return columns_of(copies, self._run.seats_of_copy)

    def _write(self, obs: tuple[Array, ...], copies: Sequence[int], leaves: Leaves, t: int, doing: str) -> None:
        """Write the observations of these copies to their places in the batch: number `t` of their episodes."""
        try:
            self._writer.write_some([array[0] for array in obs], self._columns(copies), leaves)
        except CopyFailed as error:
            raise environment_failed(None, error, doing) from error
        check_observed(None, self._stored, obs, self._run.row_axes, t)

    def _check_acted(self, chosen: Array, running: Sequence[int], obs: tuple[Array, ...], t: int) -> None:
        """As in training. The action of a copy whose episode has ended does not count."""
        if chosen.dtype.kind == "f":
            acted, columns = np.zeros_like(chosen), self._columns(running)
            acted[columns] = chosen[columns]
            check_acted(None, "action", acted[None], obs, self._run.row_axes, t)

    def _observe(self, sender: RowSender, obs: tuple[Array, ...], n: int, copies: EvaluationCopies) -> None:
        shown = obs[: len(self._run.policy.observation)]  # without the mask, and what only the critic sees
        A = self._run.seats_of_copy
        leaves = [leaf[0, n * A : (n + 1) * A] if self._run.seats else leaf[0, n] for leaf in shown]
        try:
            sender.observe(leaves, as_frame(copies.render(n)) if sender.wants_frame else None)
        except ValueError as error:
            raise environment_failed(None, f"copy {n}, {error}") from error
