"""Plays the episodes of an Evaluate order. The result depends on the order and the weights, and on nothing else.

Rule: an order has k seeds, so k env copies are stepped together, and the policy always sees a batch [1, k, ...]. A copy
whose episode has ended stays in the batch and is not stepped. The copies are apart from the lanes of training. They are
opened once, and reset with a seed before each episode.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from time import perf_counter
from typing import Any

import numpy as np

from protocol.arrays import Array
from protocol.envs.spaces import action_converter_of, action_spec, observation_leaves
from protocol.errors import UsageError
from protocol.messages import Evaluate, Evaluated
from protocol.policy.masks import stored_leaves
from protocol.policy.own_policy import OwnPolicy
from protocol.policy.policy import Policy
from protocol.policy.recurrent import zero_state
from protocol.random_streams import Purpose, generator
from protocol.rollout import LARGEST_REWARD, Episode, outside_of_space
from protocol.specs import RunSpec
from workers.collect.acting import acting_of
from workers.copies.env_errors import CopyFailed, environment_failed
from workers.copies.env_loop import Pulse
from workers.copies.env_results import leaf_writers, one_number
from workers.evaluate.episode_rows import RowSender, Send, as_frame
from workers.evaluate.evaluation_copies import CopiesLost, EvaluationCopies, LoopedEvaluationCopies

OpenEvaluationCopies = Callable[[RunSpec, int, str | None, Pulse], EvaluationCopies]
"""Makes this number of copies, with this render mode."""


def open_looped_copies(run: RunSpec, count: int, render_mode: str | None, pulse: Pulse) -> EvaluationCopies:
    """Copies in this process."""
    return LoopedEvaluationCopies(run.env, count, render_mode, pulse, run.facts, masked=run.masked)


class Evaluator:
    """Plays whole episodes. It opens env copies when they are first needed."""

    def __init__(
        self, run: RunSpec, policy: Policy | OwnPolicy, open_copies: OpenEvaluationCopies = open_looped_copies
    ) -> None:
        """`policy` must hold the weights to evaluate when `play` is called."""
        self.steps = 0
        """number of env steps made"""
        self.seconds = 0.0
        """seconds spent in `play`"""
        self._run, self._open_copies = run, open_copies
        self._acting = acting_of(run, policy)
        self._stored = stored_leaves(run)
        self._writers = leaf_writers(self._stored, 1)
        self._to_env_action = action_converter_of(run.policy)
        self._copies: dict[str | None, EvaluationCopies] = {}  # by render mode

    def play(self, order: Evaluate, send: Send, pulse: Pulse) -> Evaluated:
        """Play one episode for each seed. `send` gets the rows, if the order asks for them.

        `pulse` is called at every step and may raise. If it raises, or the environment does (`EnvironmentFailed`), all
        copies are closed.
        """
        began_s = perf_counter()
        try:
            while True:
                with suppress(CopiesLost):
                    return self._play(order, send, pulse)
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

    def _play(self, order: Evaluate, send: Send, pulse: Pulse) -> Evaluated:
        k, policy = len(order.seeds), self._run.policy
        copies = self._opened(k, "rgb_array" if order.send_frames else None, pulse)
        obs = tuple(np.empty((1, k, *leaf.shape), leaf.dtype) for leaf in self._stored)
        state, drawn = zero_state(policy, 1, k), generator(order.seeds[0], Purpose.PLAYED_ACTIONS)
        returns, lengths, cut, seconds = [0.0] * k, [0] * k, [False] * k, [0.0] * k
        no_facts = (math.nan,) * len(self._run.facts)
        facts = [no_facts] * k
        senders = [RowSender(order, n, policy, send) for n in range(k)] if order.send_rows or order.send_frames else []
        began_s = perf_counter()
        for n, leaves in enumerate(copies.reset(order.seeds, pulse)):
            self._store(obs, n, leaves, "first reset")
            if senders:
                self._observe(senders[n], obs, n, copies)
        self._check_values(obs, "first reset")
        running = list(range(k))
        while running:
            pulse()
            with np.errstate(all="ignore"):
                chosen = self._acting.choose(obs, state, drawn, greedy=order.greedy)
                # A new array at each step, because an environment may keep its action.
                actions = np.zeros((copies.count, *policy.action.shape), policy.action.dtype)
                actions[:k] = self._to_env_action(chosen)
            ended = set[int]()
            for n, step in zip(running, copies.step(actions, running, pulse), strict=True):
                reward = _finite_reward(step.reward, n, lengths[n])
                self._store(obs, n, step.leaves, lengths[n])
                returns[n] += reward
                lengths[n] += 1
                over = bool(step.terminated or step.truncated)
                cut[n] = not over and lengths[n] >= order.most_steps
                if senders:
                    self._observe(senders[n], obs, n, copies)
                    senders[n].step(chosen[n], reward, bool(step.terminated), bool(step.truncated) or cut[n])
                if over or cut[n]:
                    ended.add(n)
                    seconds[n], facts[n] = perf_counter() - began_s, step.facts or no_facts
            self._check_values(obs, lengths[running[0]] - 1)  # all that run have made equally many steps
            self.steps += len(running)
            if ended:
                running = [n for n in running if n not in ended]
        episodes = tuple(Episode(*figures) for figures in zip(returns, lengths, seconds, facts, strict=True))
        return Evaluated(order.session, order.ticket, episodes, tuple(cut))

    def _opened(self, count: int, render_mode: str | None, pulse: Pulse) -> EvaluationCopies:
        """At least this number of copies. Raises `UsageError` when their spaces are not those of the run."""
        copies = self._copies.get(render_mode)
        if copies is not None and copies.count >= count:
            return copies
        if copies is not None:
            self._copies.pop(render_mode).close()
        copies = self._copies[render_mode] = self._open_copies(self._run, count, render_mode, pulse)
        observation, action, policy = copies.observation_space, copies.action_space, self._run.policy
        if (observation_leaves(observation), action_spec(action)) != (policy.observation, policy.action):
            raise UsageError(
                f"environment {self._run.env.id}: its observations {observation} and actions {action} are not those of the "
                "policy; install the version of it that the policy was trained on"
            )
        return copies

    def _store(self, obs: tuple[Array, ...], n: int, leaves: tuple[Any, ...], when: str | int) -> None:
        """Write the observation of copy n to its place in the batch. Raises if it is not of its space.

        `when` is a text, or the number of the step.
        """
        for array, leaf, value, writer in zip(obs, self._stored, leaves, self._writers, strict=True):
            if type(value) is np.ndarray and value.dtype == array.dtype and value.shape == leaf.shape:
                array[0, n] = value
                continue
            try:
                writer.write_one(array[0], n, value)
            except CopyFailed as error:
                raise environment_failed(None, error, _moment(when)) from error

    def _check_values(self, obs: tuple[Array, ...], when: str | int) -> None:
        """Raise if an observation of the batch is not finite, or not a value of a space that counts its values."""
        for array, leaf in zip(obs, self._stored, strict=True):
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                n = next(n for n in range(array.shape[1]) if not np.isfinite(array[0, n]).all())
                where = f"copy {n}, {_moment(when)}: observation {leaf.path}".strip()
                raise environment_failed(None, f"{where}: expected finite numbers, got {array[0, n].tolist()}"[:500])
            if leaf.kind != "box" and outside_of_space(array, leaf):
                n, why = next((n, why) for n in range(array.shape[1]) if (why := outside_of_space(array[0, n], leaf)))
                where = f"copy {n}, {_moment(when)}: observation {leaf.path}".strip()
                raise environment_failed(None, f"{where}: {why}")

    def _observe(self, sender: RowSender, obs: tuple[Array, ...], n: int, copies: EvaluationCopies) -> None:
        try:
            frame = as_frame(copies.render(n)) if sender.wants_frame else None
        except ValueError as error:
            raise environment_failed(None, f"copy {n}, {error}") from error
        shown = obs[: len(self._run.policy.observation)]  # without the mask
        sender.observe([leaf[0, n] for leaf in shown], frame)


def _moment(when: str | int) -> str:
    return when if isinstance(when, str) else f"step {when}"


def _finite_reward(reward: Any, n: int, t: int) -> float:
    """The reward as a number. Raises `EnvironmentFailed` if it is none that a rollout could hold."""
    try:
        try:
            number = float(reward)
        except (TypeError, ValueError):
            number = float(one_number("reward", n, reward))
    except CopyFailed as error:
        raise environment_failed(None, error, f"step {t}") from error
    if not abs(number) <= LARGEST_REWARD:
        raise environment_failed(None, f"copy {n}, step {t}: reward: expected a finite float32, got {number}")
    return number
