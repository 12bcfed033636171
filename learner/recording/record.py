"""Experience of a run's policy, kept for others: a Minari dataset, and the plain array of [observation, action] rows.

The law: a dataset is made of whole episodes in raw rewards, and is there whole or not there. Episodes are played one after
another on one env copy, so that none is favoured for being short, each from a seed of its own, which is kept with it. The
last episode is finished, not cut: a dataset has as many steps as it was asked for and what that episode needs beyond them.
Only where this would double the number is it cut, and its last step marked truncated.
"""

from __future__ import annotations

import shutil
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import gymnasium
import msgspec
import numpy as np

from learner.evaluate import load_policy
from learner.recording.episodes import EpisodeAssembler, RecordedEpisode
from learner.recording.minari import MinariDataset
from learner.rollouts.arrived_rollout import ArrivedRollout
from learner.run_folder.atomic_write import write_atomically
from protocol.arrays import Array
from protocol.env_spec import EnvSpec
from protocol.envs.spaces import make_action_converter, make_flatten
from protocol.errors import EnvironmentFailed, RunError, UsageError, first_line
from protocol.policy.distributions import distribution
from protocol.policy.policy import Policy
from protocol.policy.recurrent import zero_state
from protocol.specs import PolicySpec


class Recorded(msgspec.Struct, frozen=True, kw_only=True):
    """What stands in a dataset."""

    dataset_id: str
    episodes: int
    steps: int
    return_mean: float
    return_std: float
    cut: int
    """episodes that did not end by themselves"""

    def __str__(self) -> str:
        cut = ", the last of them cut short" if self.cut else ""
        returns = f"return {self.return_mean:.1f} ± {self.return_std:.1f}"
        return f"dataset {self.dataset_id}: {self.steps:,} steps, {self.episodes:,} episodes{cut}, {returns}"


def record(
    run: Path,
    dataset_id: str,
    steps: int,
    seed: int,
    *,
    stochastic: bool = False,
    npy: Path | None = None,
    best: bool = False,
) -> Recorded:
    """Play the policy of a run folder and write a dataset of so many steps. Raises `OurError`, and leaves nothing then."""
    policy, spec, env_spec = load_policy(run, "best" if best else "final")
    if npy is not None and not npy.parent.is_dir():
        raise UsageError(f"{npy} cannot be written: no such folder {npy.parent}")
    env = env_spec.make()
    how = "drawn from" if stochastic else "the most probable of"
    about = f"Actions {how} the policy of millrace run {run.resolve().name}; seed {seed}."
    returns: list[float] = []
    taken = cut = 0
    try:
        player = Player(env, policy, spec, seed, stochastic)
        with _Rows(npy) as rows, MinariDataset(dataset_id, env, about) as dataset:
            while taken < steps:
                episode = player.episode(longest=2 * steps - taken)
                dataset.add(episode)
                rows.add(episode)
                returns.append(episode.total)
                taken += episode.length
                cut += player.was_cut
    finally:
        env.close()
    return Recorded(
        dataset_id=dataset_id,
        episodes=len(returns),
        steps=taken,
        return_mean=float(np.mean(returns)),
        return_std=float(np.std(returns)),
        cut=cut,
    )


class TrainingRecorder:
    """Every whole episode of training, as it was acted, into a dataset. What cannot be whole is counted."""

    def __init__(self, dataset_id: str, env_spec: EnvSpec, spec: PolicySpec, about: str) -> None:
        """Raises `UsageError` in one line where the dataset cannot be made."""
        self._env = env_spec.make()
        self._assembler = EpisodeAssembler(make_action_converter(spec.action))
        self._id = dataset_id
        self._episodes = 0
        try:
            self._dataset = MinariDataset(dataset_id, self._env, about)
        except BaseException:
            self._env.close()
            raise

    def add(self, rollouts: Sequence[ArrivedRollout]) -> None:
        """Rollouts of an update."""
        for arrived in rollouts:
            for episode in self._assembler.add(arrived.rollout, arrived.incarnation):
                self._dataset.add(episode)
                self._episodes += 1

    def close(self) -> str:
        """Write what there is; what it is, in one line. Without a whole episode there is no dataset."""
        try:
            if self._episodes:
                self._dataset.close()
            else:
                self._dataset.discard()
        finally:
            self._env.close()
        parts = self._assembler.waiting + self._assembler.left_out
        return f"dataset {self._id}: {self._episodes:,} training episodes; {parts:,} steps of others left out"


class Player:
    """Plays episode after episode on one env copy; deterministic for a seed."""

    def __init__(
        self, env: gymnasium.Env[Any, Any], policy: Policy, spec: PolicySpec, seed: int, stochastic: bool = False
    ) -> None:
        self.was_cut = False
        """the last episode did not end by itself"""
        self._env, self._policy, self._spec, self._stochastic = env, policy, spec, stochastic
        self._seeds, self._generator = (np.random.default_rng([seed, i]) for i in range(2))
        self._distribution = distribution(spec)
        self._read, self._write = make_flatten(env.observation_space), make_action_converter(spec.action)

    def episode(self, longest: int) -> RecordedEpisode:
        """The next episode, of so many steps at most. Raises `EnvironmentFailed` if the environment raises."""
        seed = int(self._seeds.integers(2**31))
        rewards: list[float] = []
        flags: list[tuple[bool, bool]] = []
        actions: list[Any] = []
        try:
            observation, _ = self._env.reset(seed=seed)
            self._state = zero_state(self._spec, 1, 1)
            seen = [self._leaves(observation)]
            while not flags or not any(flags[-1]):
                action = self._act(seen[-1])
                observation, reward, terminated, truncated, _ = self._env.step(action)
                self.was_cut = len(actions) + 1 == longest and not (terminated or truncated)
                seen.append(self._leaves(observation))
                actions.append(action)
                rewards.append(float(reward))
                flags.append((bool(terminated), bool(truncated) or self.was_cut))
        except Exception as error:
            raise _failed(self._env, error) from error
        terminations, truncations = np.array(flags, bool).T
        return RecordedEpisode(
            obs=tuple(np.stack(leaf) for leaf in zip(*seen, strict=True)),
            action=np.stack(actions),
            reward=np.array(rewards),
            terminated=terminations.copy(),
            truncated=truncations.copy(),
            seed=seed,
        )

    def _leaves(self, observation: Any) -> list[Array]:
        """An observation's arrays, copied: an environment may write into its own again."""
        leaves = zip(self._read(observation), self._spec.observation, strict=True)
        return [np.array(value, leaf.dtype) for value, leaf in leaves]

    def _act(self, leaves: list[Array]) -> Any:
        """What the environment takes."""
        params = self._policy([leaf[None, None] for leaf in leaves], self._state)[0]  # [1, P]
        if not self._stochastic:
            return self._write(self._distribution.mode(params))[0]
        return self._write(self._distribution.sample(params, self._distribution.noise(self._generator, (1,))))[0]


class _Rows:
    """The notebook's array: a row [observation, action] of float32 for each step, flattened. Written once all are there."""

    def __init__(self, target: Path | None) -> None:
        self._target = target
        self._shape = (0, 0)

    def add(self, episode: RecordedEpisode) -> None:
        """One row a step; the last observation, in which nothing was done, has none."""
        if self._target is None:
            return
        columns = [*(leaf[:-1] for leaf in episode.obs), episode.action]
        rows = np.concatenate([np.reshape(column, (episode.length, -1)) for column in columns], axis=1, dtype="<f4")
        with self._or_say_so():
            self._file.write(rows.tobytes())
        self._shape = (self._shape[0] + len(rows), rows.shape[1])

    def __enter__(self) -> Self:
        if self._target is not None:
            with self._or_say_so():
                self._file = tempfile.TemporaryFile(dir=self._target.parent)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._target is not None:
            with self._or_say_so(), self._file:
                if error is None:
                    write_atomically(self._target, self._copy_to)

    def _copy_to(self, file: BinaryIO) -> None:
        self._file.seek(0)
        np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": self._shape})
        shutil.copyfileobj(self._file, file)

    @contextmanager
    def _or_say_so(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise RunError(f"{self._target} was not written: {error.strerror}") from error


def _failed(env: gymnasium.Env[Any, Any], error: Exception) -> EnvironmentFailed:
    """What the environment raised, as ours, with its traceback as text."""
    name = env.spec.id if env.spec else type(env.unwrapped).__name__
    line = f"environment {name} raised while it was played: {type(error).__name__}: {first_line(error, '')}"
    return EnvironmentFailed(line, traceback.format_exc())
