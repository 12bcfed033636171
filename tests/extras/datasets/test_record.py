"""Recorded episodes are whole, in order and unchanged, and Minari reads their dataset."""

import re
import sys
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from millrace.extras.datasets import minari as dataset_module
from millrace.extras.datasets.episodes import EpisodeAssembler, RecordedEpisode
from millrace.extras.datasets.played_episodes import recording_seeds
from millrace.extras.datasets.prior_dataset import PriorDataset
from millrace.extras.datasets.recording import record_episodes
from millrace.extras.datasets.training_recorder import TrainingRecorder
from millrace.launch.policy_workers import PlayingWorkers, policy_player
from millrace.learner.config.layers import resolve
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.policy_player import saved_policy
from millrace.learner.rollouts.lane_history import LaneHistory
from millrace.learner.run_folder.progress import Progress
from millrace.learner.run_folder.results import RecordedDataset
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.env_actions import action_leaves_of, make_action_converter
from millrace.protocol.envs.spaces import action_spec, make_flatten, observation_leaves
from millrace.protocol.errors import EnvironmentFailed, RunError, UsageError, UserFacingError
from millrace.protocol.messages import Permit
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.layout import acting_size, buffer_size
from millrace.protocol.policy.recurrent import zero_state
from millrace.protocol.random_streams import Purpose, generator
from millrace.protocol.rollout import Rollout
from millrace.protocol.specs import PolicySpec
from millrace.workers.collect.collector import Collector
from tests.support.conversation.example_messages import example
from tests.support.examples import examples
from tests.support.in_process.collectors import TOY, no_pulse, random_policy, run_of
from tests.support.in_process.described import described
from tests.support.in_process.saved_policies import load_policy, policy_run

Array = np.ndarray[Any, Any]

# ---------------------------------------------------------------------------------------- rows of lanes -> episodes


def lives(ends: list[list[list[int]]], steps: int) -> Iterator[tuple[int, Rollout]]:
    """Incarnations of a lane as rollouts of T `steps`; `ends`: for each, for each row, for each copy: 0, or how it ends.

    An observation says where it stands: incarnation, copy, episode, step of the episode.
    """
    for incarnation, rows in enumerate(ends):
        N = len(rows[0])
        episode, step, over = np.zeros(N, int), np.zeros(N, int), np.zeros(N, bool)
        where = [np.stack([np.full(N, incarnation), np.arange(N), episode, step], -1)]
        valid, terminated, truncated = [], [], []
        for flags in rows:
            valid.append(~over)
            flag = np.where(over, 0, flags)
            episode, step = np.where(over, episode + 1, episode), np.where(over, 0, step + 1)
            terminated.append(flag % 2 == 1)
            truncated.append(flag >= 2)
            over = flag > 0
            where.append(np.stack([np.full(N, incarnation), np.arange(N), episode, step], -1))
        obs = np.array(where, np.float32)
        for sequence in range(len(rows) // steps):
            at = slice(sequence * steps, (sequence + 1) * steps)
            seen = obs[at.start : at.stop + 1].copy()
            yield (
                incarnation,
                example(
                    Rollout,
                    session=1,
                    lane=3,
                    ticket=sequence,
                    sequence=sequence,
                    obs=(seen, seen[..., 3].astype(np.int64)),
                    action=(10 * seen[:-1, :, 2] + seen[:-1, :, 3]).astype(np.int64),
                    log_prob=np.zeros((steps, N), np.float32),
                    reward=seen[1:, :, 3].copy(),
                    terminated=np.array(terminated[at]),
                    truncated=np.array(truncated[at]),
                    valid=np.array(valid[at]),
                    state=np.zeros((N, 0), np.float32),
                ),
            )


@st.composite
def rollouts(draw: st.DrawFn) -> list[tuple[int, Rollout]]:
    steps, copies = draw(st.integers(1, 5)), draw(st.integers(1, 3))
    row = st.lists(st.sampled_from([0, 0, 0, 1, 2, 3]), min_size=copies, max_size=copies)
    counts = draw(st.lists(st.integers(1, 6), min_size=1, max_size=3))
    ends = [draw(st.lists(row, min_size=steps * count, max_size=steps * count)) for count in counts]
    return list(lives(ends, steps))


def check_whole(episode: RecordedEpisode) -> None:
    """It has no hole: of one incarnation, copy and episode, every step from the first to the last."""
    (where, step), L = episode.obs, episode.length
    assert (where[:, :3] == where[0, :3]).all()
    assert where[:, 3].tolist() == step.tolist() == list(range(L + 1))
    assert episode.reward.tolist() == list(range(1, L + 1))
    assert episode.action[0].tolist() == [100 + 10 * where[0, 2] + t for t in range(L)]
    ended = episode.terminated | episode.truncated
    assert ended[-1]
    assert not ended[:-1].any()


def taken(action: Array) -> tuple[Array, ...]:
    return (action + 100,)


@examples(100)
@given(rollouts())
def test_the_episodes_of_a_copy_are_its_rows_without_the_resets(stream: list[tuple[int, Rollout]]) -> None:
    assembler = EpisodeAssembler(taken)
    episodes = [episode for each in stream for episode in assembler.add(each[1], each[0], fresh=each[1].sequence == 0)]
    for episode in episodes:
        check_whole(episode)
    steps = sum(rollout.env_steps for _, rollout in stream)
    assert sum(episode.length for episode in episodes) + assembler.waiting + assembler.left_out == steps
    for incarnation in {incarnation for incarnation, _ in stream}:
        rows = [rollout for i, rollout in stream if i == incarnation]
        obs, valid, action, reward, terminated, truncated = (
            np.concatenate(arrays)
            for arrays in (
                [r.obs[0][:-1] for r in rows],
                [r.valid for r in rows],
                [taken(r.action)[0] for r in rows],
                [r.reward for r in rows],
                [r.terminated for r in rows],
                [r.truncated for r in rows],
            )
        )
        for n in range(obs.shape[1]):
            mine = [e for e in episodes if tuple(e.obs[0][0, :2]) == (incarnation, n)]
            done = np.flatnonzero((terminated | truncated)[:, n])
            kept = np.flatnonzero(valid[: done[-1] + 1 if len(done) else 0, n])
            assert sum(e.length for e in mine) == len(kept)
            if mine:
                assert np.array_equal(np.concatenate([e.obs[0][:-1] for e in mine]), obs[kept, n])
                assert np.array_equal(np.concatenate([e.action[0] for e in mine]), action[kept, n])
                assert np.array_equal(np.concatenate([e.reward for e in mine]), reward[kept, n])
                assert np.array_equal(np.concatenate([e.terminated for e in mine]), terminated[kept, n])
                assert np.array_equal(np.concatenate([e.truncated for e in mine]), truncated[kept, n])


@examples(100)
@given(rollouts(), st.data())
def test_an_episode_has_no_hole_whatever_is_dropped_or_late(stream: list[tuple[int, Rollout]], data: st.DataObject) -> None:
    came = data.draw(st.lists(st.sampled_from(range(len(stream))), max_size=len(stream), unique=True))
    if data.draw(st.booleans()):
        came = sorted(came)
    assembler = EpisodeAssembler(taken)
    episodes, steps = [], 0
    for i in came:
        incarnation, rollout = stream[i]
        episodes += assembler.add(rollout, incarnation, fresh=rollout.sequence == 0)
        steps += rollout.env_steps
    for episode in episodes:
        check_whole(episode)
    starts = [tuple(episode.obs[0][0]) for episode in episodes]
    assert len(set(starts)) == len(starts)
    assert sum(episode.length for episode in episodes) + assembler.waiting + assembler.left_out == steps


@examples(100)
@given(rollouts(), st.data())
def test_an_episode_has_no_hole_where_steps_are_in_no_rollout(
    stream: list[tuple[int, Rollout]], data: st.DataObject
) -> None:
    """A client that owns its loop leaves steps out between two rollouts; then the first row is not valid."""
    sequences: Counter[int] = Counter()
    gaps: set[int] = set()
    assembler, episodes, steps = EpisodeAssembler(taken), [], 0
    for incarnation, rollout in stream:
        if data.draw(st.booleans()):  # this one is not recorded
            gaps.add(incarnation)
            continue
        if incarnation in gaps:
            rollout.valid[0] = False
            gaps.remove(incarnation)
        rollout = msgspec.structs.replace(rollout, sequence=sequences[incarnation])
        sequences[incarnation] += 1
        episodes += assembler.add(rollout, incarnation, fresh=rollout.sequence == 0)
        steps += rollout.env_steps
    for episode in episodes:
        check_whole(episode)
    assert sum(episode.length for episode in episodes) + assembler.waiting + assembler.left_out == steps


def test_what_is_kept_is_a_copy() -> None:
    ((_, first), (_, second)) = lives([[[0], [0], [0], [1]]], steps=2)
    assembler = EpisodeAssembler(lambda action: (action,))
    assert assembler.add(first, 0, fresh=True) == []
    for array in (*first.obs, first.action, first.reward):
        array[...] = 77
    (episode,) = assembler.add(second, 0, fresh=False)
    assert episode.obs[1].tolist() == [0, 1, 2, 3, 4]
    assert episode.action[0].tolist() == [0, 1, 2, 3]
    assert (assembler.waiting, assembler.left_out) == (0, 0)


def test_the_episode_that_ended_first_comes_first() -> None:
    ((_, rollout),) = lives([[[0, 0], [0, 1], [1, 0], [0, 1]]], steps=4)
    episodes = EpisodeAssembler(taken).add(rollout, 0, fresh=True)
    assert [(int(episode.obs[0][0, 1]), episode.length) for episode in episodes] == [(1, 2), (0, 3), (1, 1)]


# ----------------------------------------------------------------------------------------------- a policy -> a dataset


class Box(gymnasium.Env[Any, Any]):
    """A Dict of Tuple observation. Episodes of 3, 4, 5, 3, … steps; odd ones are truncated, even ones terminated."""

    def __init__(self, endless: bool = False, fails_at: int = 0, key: str = "inner") -> None:
        self.observation_space = spaces.Dict(
            {
                "step": spaces.Discrete(1000, start=-1),
                key: spaces.Tuple((spaces.Box(-9, 9, (2,)), spaces.MultiBinary(3))),
                "camera": spaces.Box(0, 255, (4, 5), np.uint8),
            }
        )
        self.action_space = spaces.Box(np.float32(-0.25), np.float32(0.25), (2,))
        self.key, self.endless, self.fails_at = key, endless, fails_at
        self.episode, self.steps, self.total = -1, 0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.episode, self.steps = self.episode + 1, 0
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps, self.total = self.steps + 1, self.total + 1
        if self.total == self.fails_at:
            raise RuntimeError("the spring broke")
        ended = not self.endless and self.steps == 3 + self.episode % 3
        odd = self.episode % 2 == 1
        return self._seen(), 0.1 * self.steps, ended and not odd, ended and odd, {"noise": 1}

    def _seen(self) -> dict[str, Any]:
        random = self.np_random
        inner = (random.normal(size=2).astype(np.float32).clip(-9, 9), random.integers(0, 2, 3, np.int8))
        return {"step": self.steps - 1, self.key: inner, "camera": random.integers(0, 256, (4, 5), np.uint8)}


class Blindfolded(gymnasium.Env[Any, Any]):
    """All observations are equal. Episodes of 5 steps."""

    observation_space = spaces.Discrete(1)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return 0, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return 0, 1.0, self.steps == 5, False, {}


gymnasium.register("millrace-tests/Blindfolded-v0", entry_point=lambda **_: Blindfolded())
gymnasium.register("millrace-tests/Box-v0", entry_point=lambda **kwargs: Box(**kwargs))


def a_run(folder: Path, env: EnvSpec) -> Path:
    made = env.make()
    spec = PolicySpec(observation_leaves(made.observation_space), action_spec(made.action_space), net=(8,))
    run = RunFolder.create(resolve(env.id, run_dir=str(folder)))
    rng = np.random.default_rng(0)
    run.write_policy(
        policy_run(spec, env),
        0.1 * rng.standard_normal(acting_size(spec), np.float32),
        np.zeros(buffer_size(spec), np.float32),
    )
    return run.path


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return tmp_path / "datasets"


def read(dataset_id: str) -> Any:
    import minari

    return minari.load_dataset(dataset_id)


def record(
    run: Path,
    dataset_id: str,
    steps: int,
    seed: int,
    stochastic: bool = False,
    npy: Path | None = None,
    workers: int = 1,
) -> RecordedDataset:
    playing = PlayingWorkers(workers, "inproc", settings=RolloutConfig(max_env_failures=0))
    with policy_player(saved_policy(run), playing, lambda text: None) as player:
        return record_episodes(player, run, dataset_id, steps, seed, stochastic=stochastic, npy=npy)


def played(run: Path, seed: int, stochastic: bool, episodes: int) -> list[RecordedEpisode]:
    """The episodes as a plain loop plays them."""
    policy, spec, env_spec = load_policy(run)
    env, chosen, write = env_spec.make(), distribution(spec), make_action_converter(spec.action)
    read = make_flatten(env.observation_space)
    found = []
    for _, reset_seed in zip(range(episodes), recording_seeds(seed), strict=False):
        drawn = generator(reset_seed, Purpose.PLAYED_ACTIONS)
        obs: list[Any] = [env.reset(seed=reset_seed)[0]]
        rows: list[Any] = []
        while not rows or not (rows[-1][2] or rows[-1][3]):
            leaves = [
                np.asarray(leaf, own.dtype)[None, None] for leaf, own in zip(read(obs[-1]), spec.observation, strict=True)
            ]
            params = policy(leaves, zero_state(spec, 1, 1))
            action = chosen.sample(params, chosen.noise(drawn, (1, 1))) if stochastic else chosen.mode(params)
            taken = write(action[0])[0]
            observation, reward, terminated, truncated, _ = env.step(taken)
            obs.append(observation)
            rows.append((taken, reward, terminated, truncated))
        actions, rewards, terminations, truncations = (np.array(column) for column in zip(*rows, strict=True))
        leaves = [np.stack(leaf) for leaf in zip(*map(read, obs), strict=True)]
        found.append(RecordedEpisode(tuple(leaves), (actions,), rewards, terminations, truncations, reset_seed))
    return found


@pytest.mark.parametrize("chunk_bytes", [1, 2**30])
def test_minari_reads_back_what_was_played(
    tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch, chunk_bytes: int
) -> None:
    monkeypatch.setattr(dataset_module, "CHUNK_BYTES", chunk_bytes)
    run = a_run(tmp_path, EnvSpec("millrace-tests/Box-v0"))
    found = record(run, "tests/box/mixed-v0", 40, seed=5, stochastic=True)
    # Lengths 3, 4, 5 in turn: the eleventh episode, of 4 steps, is the one that passes 40.
    assert (found.steps, found.episodes, found.cut) == (43, 11, 0)
    expected = played(run, 5, True, 11)
    dataset = read("tests/box/mixed-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (11, 43)
    assert dataset.observation_space == Box().observation_space
    for i, (got, want) in enumerate(zip(dataset.iterate_episodes(), expected, strict=True)):
        L = 3 + i % 3
        assert len(got.rewards) == len(got.actions) == want.length == L
        assert np.array_equal(got.rewards, [0.1 * (t + 1) for t in range(L)])
        assert got.terminations.tolist() == [False] * (L - 1) + [i % 2 == 0]
        assert got.truncations.tolist() == [False] * (L - 1) + [i % 2 == 1]
        assert got.observations["step"].tolist() == list(range(-1, L))  # the last one is that of the end, not of a reset
        leaves = [got.observations["camera"], *got.observations["inner"], got.observations["step"]]
        names = [leaf.path for leaf in observation_leaves(Box().observation_space)]
        assert names == ["camera", "inner/0", "inner/1", "step"]
        for leaf, array in zip(leaves, want.obs, strict=True):
            assert len(leaf) == L + 1
            assert leaf.dtype == array.dtype
            assert np.array_equal(leaf, array)
        assert np.array_equal(got.actions, want.action[0])
        assert got.actions.dtype == np.float32
        assert np.abs(got.actions).max() <= 0.25  # as the environment took them: clipped
    seeds = [metadata["seed"] for metadata in dataset.storage.get_episode_metadata(range(11))]
    assert seeds == [episode.seed for episode in expected]
    returns = [episode.episode_return for episode in expected]
    assert [found.return_mean, found.return_std] == [float(np.mean(returns)), float(np.std(returns))]


@pytest.mark.parametrize("eval_kwargs", [{}, {"sutton_barto_reward": True}])
def test_the_environment_comes_back_with_the_dataset_and_each_episode_can_be_repeated(
    eval_kwargs: dict[str, Any], tmp_path: Path, root: Path
) -> None:
    run = a_run(tmp_path, EnvSpec("CartPole-v1", eval_kwargs=eval_kwargs))
    assert str(record(run, "cartpole/greedy-v0", 60, seed=1)).startswith("dataset cartpole/greedy-v0: ")
    dataset = read("cartpole/greedy-v0")
    env = dataset.recover_environment()
    assert env.spec == gymnasium.make("CartPole-v1", **eval_kwargs).spec, "what Minari's own tests compare"
    for episode, metadata in zip(dataset, dataset.storage.get_episode_metadata(range(len(dataset))), strict=True):
        obs, _ = env.reset(seed=metadata["seed"])
        for t, action in enumerate(episode.actions):
            assert np.array_equal(obs, episode.observations[t])
            obs, reward, terminated, truncated, _ = env.step(action)
            assert reward == episode.rewards[t]
        assert np.array_equal(obs, episode.observations[-1])
        assert (terminated, truncated) == (episode.terminations[-1], episode.truncations[-1])
    env.close()


def test_images_are_kept_as_they_are(root: Path) -> None:
    env = Box()
    env.observation_space = spaces.Box(0, 255, (8, 9, 3), np.uint8)
    images = np.random.default_rng(0).integers(0, 256, (3, 8, 9, 3), np.uint8)
    with dataset_module.MinariDataset("tests/images-v0", env, "two steps") as dataset:
        flags = np.zeros(2, bool)
        dataset.add(RecordedEpisode((images,), (np.zeros((2, 2), np.float32),), np.zeros(2), flags, flags))
    (episode,) = read("tests/images-v0")
    assert np.array_equal(episode.observations, images)


def test_the_same_seed_plays_the_same_and_drawn_actions_are_not_the_most_probable(tmp_path: Path) -> None:
    run = a_run(tmp_path, EnvSpec("CartPole-v1"))
    first, again, drawn = (played(run, 3, stochastic, 2) for stochastic in (False, False, True))
    for a, b in zip(first, again, strict=True):
        assert np.array_equal(a.action[0], b.action[0])
        assert np.array_equal(a.obs[0], b.obs[0])
    assert first[0].seed == drawn[0].seed
    assert not np.array_equal(first[0].action[0], drawn[0].action[0])


def test_the_dataset_does_not_depend_on_the_number_of_workers(tmp_path: Path, root: Path) -> None:
    run = a_run(tmp_path, EnvSpec("CartPole-v1"))
    found = [record(run, f"tests/by-{n}-v0", 400, seed=1, stochastic=True, workers=n) for n in (1, 3)]
    assert found[0].episodes == found[1].episodes > 5
    for one, other in zip(read("tests/by-1-v0"), read("tests/by-3-v0"), strict=True):
        assert np.array_equal(one.observations, other.observations)
        assert np.array_equal(one.actions, other.actions)


def test_the_notebooks_array_has_a_row_for_each_step(tmp_path: Path, root: Path) -> None:
    run = a_run(tmp_path, EnvSpec("millrace-tests/Box-v0"))
    record(run, "tests/box-v0", 10, seed=2, npy=tmp_path / "rows.npy")
    rows = np.load(tmp_path / "rows.npy", allow_pickle=False)
    assert (rows.shape, rows.dtype) == ((12, 20 + 2 + 3 + 1 + 2), np.float32)
    t = 0
    for episode in played(run, 2, False, 3):
        for step in range(episode.length):
            row = np.concatenate([np.ravel(leaf[step]) for leaf in episode.obs] + [episode.action[0][step]]).astype(
                np.float32
            )
            assert np.array_equal(rows[t], row)
            t += 1
    assert t == 12
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_file()) == ["rows.npy"]


def test_an_episode_that_would_double_the_steps_is_cut_and_marked_truncated(tmp_path: Path, root: Path) -> None:
    run = a_run(tmp_path, EnvSpec("millrace-tests/Box-v0", {"endless": True}))
    found = record(run, "tests/endless-v0", 7, seed=1)
    assert (found.steps, found.episodes, found.cut) == (14, 1, 1)
    assert "14 steps, 1 episodes, the last of them cut short, return" in str(found)
    (episode,) = read("tests/endless-v0")
    assert episode.truncations.tolist() == [False] * 13 + [True]
    assert not episode.terminations.any()
    assert len(episode.observations["step"]) == 15


# ------------------------------------------------------------------------------------------------------ what goes wrong


def everything(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*")} if root.exists() else set()


def fails(run: Path, dataset_id: str, kind: type[UserFacingError], says: str, npy: Path | None = None) -> UserFacingError:
    with pytest.raises(kind, match=says) as caught:
        record(run, dataset_id, 40, seed=1, npy=npy)
    assert "\n" not in str(caught.value)
    return caught.value


def test_nothing_is_left_of_a_dataset_whose_environment_raises(
    tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dataset_module, "CHUNK_BYTES", 1)  # some episodes are written by then
    run = a_run(tmp_path, EnvSpec("millrace-tests/Box-v0", {"fails_at": 20}))
    error = fails(run, "new/deep/box-v0", EnvironmentFailed, "its environment raised RuntimeError: the spring broke")
    assert "in step" in error.detail
    assert everything(root) == set()


def test_a_namespace_with_another_dataset_in_it_stays(tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good = a_run(tmp_path, EnvSpec("millrace-tests/Box-v0"))
    record(good, "ours/good-v0", 5, seed=1)
    before = everything(root)
    bad = a_run(tmp_path / "bad", EnvSpec("millrace-tests/Box-v0", {"fails_at": 2}))
    fails(bad, "ours/deeper/bad-v0", EnvironmentFailed, "the spring broke")
    assert everything(root) == before
    fails(good, "ours/good-v0", UsageError, "dataset ours/good-v0 is there already, at .*; choose another name or version")
    assert everything(root) == before


def test_without_the_rows_there_is_no_dataset(tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("millrace.extras.datasets.npy_rows.write_atomically", full)
    run = a_run(tmp_path, EnvSpec("millrace-tests/Box-v0"))
    fails(run, "ns/box-v0", RunError, "rows.npy was not written: No space left on device", npy=tmp_path / "rows.npy")
    assert everything(root) == set()


def test_folders_that_lead_around_in_a_circle_hold_nobody_up(tmp_path: Path, root: Path) -> None:
    """Another dataset may come from a stranger."""
    theirs = root / "theirs"
    theirs.mkdir(parents=True)
    for name in ("a", "b", "c"):
        (theirs / name).symlink_to(theirs)
    record(a_run(tmp_path, EnvSpec("millrace-tests/Box-v0")), "ours/deeper/good-v0", 5, seed=1)
    assert (root / "ours" / "namespace_metadata.json").read_text() == "{}"
    policy = PolicySpec(observation_leaves(spaces.Discrete(2)), action_spec(spaces.Discrete(2)))
    with pytest.raises(UsageError, match=r"no such dataset here; there are: ours/deeper/good-v0\."):
        PriorDataset("ours/bad-v0", policy)


def test_what_minari_leaves_when_it_fails_is_removed(tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from minari.dataset.minari_storage import MinariStorage

    def full(*_: Any, **__: Any) -> None:
        assert "ns/box-v0/data" in everything(root)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(MinariStorage, "new", full)
    run = a_run(tmp_path, EnvSpec("millrace-tests/Box-v0"))
    says = "dataset ns/box-v0 was not written: OSError: .*No space left on device"
    fails(run, "ns/box-v0", RunError, says, npy=tmp_path / "rows.npy")
    assert everything(root) == set()
    assert not [path for path in tmp_path.iterdir() if path.is_file()]


@pytest.mark.parametrize("chunk_bytes", [1, 2**20])
def test_nothing_is_left_of_a_training_dataset_that_cannot_be_written(
    root: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, chunk_bytes: int
) -> None:
    """`chunk_bytes`: whether the second episode is written while the run trains, or at its end."""
    from minari.dataset.minari_storage import MinariStorage

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    run = run_of(f"{TOY}Countdown-v0", T=6, N=1)  # an episode, and the reset after it
    collector = Collector(run, random_policy(run.policy))
    first, second = (
        Progress(
            updates=n,
            rollouts=(collector.collect([Permit(n, 0, 0, n, n)], 0, 1, no_pulse)[0],),
            incarnations=(0,),
            fresh=(n == 0,),
        )
        for n in range(2)
    )
    recorder = TrainingRecorder("ns/countdown-v0", described(run.env), run, "a test")
    monkeypatch.setattr(dataset_module, "CHUNK_BYTES", chunk_bytes)
    recorder.on_rollouts(first)
    recorder.on_update(Progress(updates=1))
    monkeypatch.setattr(dataset_module, "append_episodes", full)
    monkeypatch.setattr(MinariStorage, "new", full)
    says = "dataset ns/countdown-v0 was not written: OSError: .*No space left on device"
    if chunk_bytes == 1:
        assert "ns/countdown-v0/data" in everything(root)
        recorder.on_rollouts(second)
        recorder.on_update(Progress(updates=2))
        assert re.fullmatch(f"{says}; it is removed, and training continues", caplog.messages[-1])
        assert everything(root) == set()
        recorder.on_rollouts(second)
        recorder.on_end(Progress(updates=2, cut_short=True))  # the run has an error of its own
        assert len(caplog.messages) == 1, "it is said once"
    else:
        recorder.on_rollouts(second)
    with pytest.raises(RunError, match=says):
        recorder.on_end(Progress(updates=2))
    assert everything(root) == set()


def test_rollouts_are_recorded_once_an_update_has_used_them(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A resumed run collects or uses the rollouts of an undone update again. Another callback may raise after an update."""
    run = run_of(f"{TOY}Countdown-v0", T=6, N=1)  # an episode, and the reset after it
    for used in (False, True):
        collector = Collector(run, random_policy(run.policy))
        recorder = TrainingRecorder("ns/countdown-v0", described(run.env), run, "a test")
        for updates in range(2):
            rollouts = collector.collect([Permit(updates, 0, 0, updates, updates)], 0, 1, no_pulse)
            recorder.on_rollouts(
                Progress(updates=updates, rollouts=tuple(rollouts), incarnations=(0,), fresh=(updates == 0,))
            )
        recorder.on_end(Progress(updates=1 + used, cut_short=True))
        assert f"dataset ns/countdown-v0: {1 + used} training episodes; 0 steps of others" in caplog.messages[-1]
        (root / "ns").rename(root / f"used{used}")


def test_an_episode_that_another_worker_goes_on_with_is_recorded_whole() -> None:
    run = run_of("CartPole-v1", T=7, N=3)
    history = LaneHistory.of_nothing(3, most_steps=500)
    to_env_action = action_leaves_of(run.policy)
    moved, whole = EpisodeAssembler(to_env_action), EpisodeAssembler(to_env_action)
    stayed, went = (Collector(run, random_policy(run.policy)) for _ in range(2))
    found: dict[str, list[RecordedEpisode]] = {"moved": [], "whole": []}
    for n in range(12):
        (rollout,) = stayed.collect([Permit(n, 0, 0, n, n)], 0, 1, no_pulse)
        found["whole"] += whole.add(rollout, 0, fresh=n == 0)
        incarnation, sequence = (0, n) if n < 5 else (1, n - 5)
        if incarnation:
            past = history.past(0) if not sequence else None
            (rollout,) = went.collect([Permit(n, 0, 1, sequence, n, past=past)], 0, 1, no_pulse)
        fresh = history.add(rollout, b"")
        found["moved"] += moved.add(rollout, incarnation, fresh | (n == 0))
    assert moved.left_out == 0
    assert len(found["moved"]) == len(found["whole"]) > 3
    for one, other in zip(found["moved"], found["whole"], strict=True):
        np.testing.assert_array_equal(one.obs[0], other.obs[0])


@pytest.mark.parametrize(
    ("T", "steps_left_out"),
    [
        pytest.param(3, 2, id="within an episode"),
        pytest.param(5, 0, id="before a reset"),
        pytest.param(6, 5, id="after one"),
    ],
)
def test_after_a_resume_episodes_are_recorded_whose_reset_came_after_it(T: int, steps_left_out: int) -> None:
    """Episodes of 5 steps, each followed by a row of its reset. The run is resumed after the first rollout."""
    run = run_of(f"{TOY}Countdown-v0", T=T, N=2)
    history = LaneHistory.of_nothing(2, most_steps=500)
    (rollout,) = Collector(run, random_policy(run.policy)).collect([Permit(0, 0, 0, 0, 0)], 0, 1, no_pulse)
    history.add(rollout, b"")
    resumed = Collector(run, random_policy(run.policy))
    assembler, episodes = EpisodeAssembler(action_leaves_of(run.policy)), []
    for n in range(6):
        past = None if n else history.past(0)
        (rollout,) = resumed.collect([Permit(n, 0, 1, n, n + 1, past=past)], 0, 1, no_pulse)
        episodes += assembler.add(rollout, 1, history.add(rollout, b""))
    assert len(episodes) > 3
    assert {(episode.length, float(episode.obs[0][0, 0])) for episode in episodes} == {(5, 1.0)}
    assert assembler.left_out == 2 * steps_left_out


def test_an_episode_that_was_lost_is_not_joined_with_the_next_one_even_if_all_observations_are_equal() -> None:
    run = run_of("millrace-tests/Blindfolded-v0", T=3, N=2)
    history = LaneHistory.of_nothing(2, most_steps=500)
    assembler, episodes = EpisodeAssembler(action_leaves_of(run.policy)), []
    for incarnation in range(2):
        collector = Collector(run, random_policy(run.policy))
        for n in range(5):
            past = history.past(0) if incarnation and not n else None
            (rollout,) = collector.collect([Permit(n, 0, incarnation, n, n, past=past)], 0, 1, no_pulse)
            fresh = history.add(rollout, b"") | (incarnation == n == 0)
            episodes += assembler.add(rollout, incarnation, fresh)
        history.start_anew(1, from_past=False)  # the environment has failed
    assert [episode.length for episode in episodes] == [5] * 8
    assert assembler.left_out == assembler.waiting == 2 * 3


def test_a_run_that_ends_before_a_whole_episode_leaves_no_dataset(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = run_of(f"{TOY}Countdown-v0", T=3, N=1)
    collector = Collector(run, random_policy(run.policy))
    recorder = TrainingRecorder("ns/countdown-v0", described(run.env), run, "a test")
    (rollout,) = collector.collect([Permit(0, 0, 0, 0, 0)], 0, 1, no_pulse)
    recorder.on_rollouts(Progress(rollouts=(rollout,), incarnations=(0,), fresh=(True,)))
    recorder.on_end(Progress(updates=1))
    assert caplog.messages == ["dataset ns/countdown-v0: 0 training episodes; 3 steps of others left out"]
    assert everything(root) == set()


@pytest.mark.parametrize("dataset_id", ["box", "../box-v0", "/abs/box-v0", "two words-v0", ""])
def test_a_dataset_needs_a_name_that_minari_takes(tmp_path: Path, root: Path, dataset_id: str) -> None:
    run = a_run(tmp_path, EnvSpec("millrace-tests/Box-v0"))
    fails(run, dataset_id, UsageError, "expected names of two letters or more and a version, as in cartpole/expert-v0")
    assert everything(root) == set()


def test_what_cannot_be_kept_is_said_before_a_step_is_made(
    tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = a_run(tmp_path, EnvSpec("millrace-tests/Box-v0"))
    fails(run, "ns/box-v0", UsageError, "cannot be written: no such folder", npy=tmp_path / "no" / "rows.npy")
    slashed = a_run(tmp_path / "slashed", EnvSpec("millrace-tests/Box-v0", {"key": "a/b"}))
    fails(slashed, "ns/box-v0", UsageError, "Minari cannot keep an observation whose key has a slash, a/b")
    for module in ("h5py", "PIL"):  # Minari's own storage imports Pillow
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, module, None)
            fails(run, "ns/box-v0", UsageError, r"recording needs minari; pip install 'minari\[hdf5\]' pillow")
    assert everything(root) == set()


def test_minaris_own_warnings_stay_its_own(tmp_path: Path, root: Path) -> None:
    run = a_run(tmp_path, EnvSpec("CartPole-v1"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        record(run, "tests/quiet-v0", 10, seed=1)
    assert not caught
