"""Every space a policy can see or act in, from the environment into a rollout and back; the others in one line."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from millrace.learner.algorithm_check.same_bits import first_difference
from millrace.protocol.action_parts import parts_of
from millrace.protocol.arrays import Array
from millrace.protocol.envs.env_actions import action_leaves_of, make_action_converter, stored_actions_of
from millrace.protocol.envs.spaces import (
    action_spec,
    leaves_with_own_dtype,
    make_flatten,
    make_unflatten,
    observation_leaves,
)
from millrace.protocol.errors import BadRollout, UsageError
from millrace.protocol.rollout import Episode, Rollout
from millrace.protocol.rows.rollout_checks import validate, wrong_facts
from millrace.protocol.specs import ActionSpec, PolicySpec, RunSpec
from tests.support.envs.toy import ACTIONS, OBSERVATIONS, UNSUPPORTED_ACTIONS, UNSUPPORTED_OBSERVATIONS
from tests.support.in_process.collectors import TOY, bits, collect, random_collector, run_of, sync_vector_env_over

ROOT = Path(__file__).parents[3]
SEEN = sorted(OBSERVATIONS.keys() - UNSUPPORTED_OBSERVATIONS)
DONE = sorted(ACTIONS.keys() - UNSUPPORTED_ACTIONS)


def spaces_run(observation: str = "box", action: str = "discrete") -> RunSpec:
    return run_of(f"{TOY}Spaces-v0", T=6, N=3, kwargs={"observation": observation, "action": action})


@pytest.mark.parametrize(("observation", "action"), [(seen, "discrete") for seen in SEEN] + [("box", done) for done in DONE])
def test_every_space_collects_alike_in_a_loop_and_in_a_vector_environment(observation: str, action: str) -> None:
    run = spaces_run(observation, action)
    loop, sync = random_collector(run), random_collector(run, sync_vector_env_over([run.env.make] * 3))
    for k in range(2):
        ours, theirs = (collect(collector, run, k, lanes=(0, 1)) for collector in (loop, sync))  # the toy checks its actions
        assert [bits(rollout) for rollout in ours] == [bits(rollout) for rollout in theirs]
        assert all(map(np.ptp, ours[0].obs))  # something was seen,
        assert np.ptp(ours[0].action)  # and done
        assert (ours[0].reward[~ours[0].valid] == 0).all()


@pytest.mark.parametrize("observation", SEEN)
def test_the_leaves_of_an_observation_are_its_arrays_as_they_are(observation: str) -> None:
    run, space = spaces_run(observation), OBSERVATIONS[observation]
    (rollout,) = collect(random_collector(run), run)
    env = run.env.make()
    for leaf, array in zip(observation_leaves(space), rollout.obs, strict=True):
        inner = space
        for key in filter(None, leaf.path.split("/")):
            inner = inner[int(key) if key.isdigit() else key]  # type: ignore[index]
        for value in array.reshape(-1, *leaf.shape):
            assert inner.contains(np.asarray(value) if leaf.kind == "box" else value)
    env.close()


def test_leaves_are_named_by_their_path_and_keep_the_order_of_the_space() -> None:
    leaves = observation_leaves(OBSERVATIONS["nested"])
    assert [(leaf.path, leaf.kind, leaf.shape, leaf.dtype) for leaf in leaves] == [
        ("arm/0", "discrete", (), "int64"),
        ("arm/1", "box", (3,), "float32"),
        ("camera/left", "box", (12, 12, 3), "uint8"),
    ]
    assert [leaf.is_image for leaf in leaves] == [False, False, True]
    assert (leaves[0].sizes, leaves[0].start) == ((4,), (-1,))


@pytest.mark.parametrize("observation", SEEN)
def test_a_batch_is_read_like_one_observation(observation: str) -> None:
    space = OBSERVATIONS[observation]
    read, leaves = make_flatten(space), observation_leaves(space)
    one, batch = read(space.sample()), read(batch_space(space, 5).sample())
    for leaf, single, several in zip(leaves, one, batch, strict=True):
        assert np.shape(single) == leaf.shape
        assert np.shape(several) == (5, *leaf.shape)


def stored_actions(spec: ActionSpec, count: int) -> Array:
    """Random actions [count, *action] as rollouts store them."""
    if spec.parts:
        drawn = {part.columns.start: stored_actions(part.spec, count).reshape(count, -1) for part in parts_of(spec)}
        return np.concatenate([drawn[start] for start in sorted(drawn)], 1).astype(np.float32)
    generator = np.random.default_rng(0)
    shape = (count, *spec.shape)
    if spec.kind == "box":
        return generator.normal(0, 10, shape).astype(np.float32)
    return generator.integers(0, np.reshape(spec.sizes, spec.shape) if spec.sizes else 2, shape)


@pytest.mark.parametrize("action", DONE)
def test_whatever_is_sampled_is_written_into_the_space(action: str) -> None:
    space = ACTIONS[action]
    policy = PolicySpec((), action_spec(space))
    stored = stored_actions(policy.action, 50)
    before = stored.copy()
    leaves = action_leaves_of(policy)(stored)
    assert [leaf.dtype for leaf in leaves] == [leaf.dtype for leaf in leaves_with_own_dtype(space)]
    structures = [make_unflatten(space)([np.asarray(leaf[n]) for leaf in leaves]) for n in range(50)]
    assert all(map(space.contains, structures))  # a Box without dimensions wants an array, and gets a number below
    written = make_action_converter(policy.action)(stored)
    flatten = make_flatten(space)
    for row, structure in zip(written, structures, strict=True):
        assert first_difference([np.asarray(leaf) for leaf in flatten(row)], list(flatten(structure))) is None
    assert (stored == before).all()


@pytest.mark.parametrize("action", DONE)
def test_actions_of_the_environment_come_back_from_stored_ones(action: str) -> None:
    policy = PolicySpec((), action_spec(ACTIONS[action]))
    taken = action_leaves_of(policy)(stored_actions(policy.action, 50))
    stored = stored_actions_of(policy)(taken)
    assert stored.dtype == policy.action.stored_dtype
    assert stored.shape == (50, *policy.action.shape)
    assert first_difference(action_leaves_of(policy)(stored), taken) is None


def test_a_row_has_all_choices_then_all_bits_then_all_numbers() -> None:
    spec = action_spec(ACTIONS["mixed"])
    assert (spec.kind, spec.shape, spec.stored_dtype) == ("mixed", (1 + 4 + 1 + 2 + 2 + 1,), "float32")
    assert (spec.sizes, spec.start, spec.bits) == ((3, 2, 3, 4, 5, 4), (5, 1, 0, 0, -2, 0), 2)
    assert (spec.low, spec.high) == ((0.0, -0.1, -0.1), (math.inf, 0.1, 0.1))
    assert [(part.path, part.kind, part.shape, part.dtype) for part in spec.parts] == [
        (("arm", 0), "discrete", (), "int64"),
        (("arm", 1), "multidiscrete", (2, 2), "int64"),
        (("arm", 2, "grip"), "multibinary", (2,), "int8"),
        (("brake",), "box", (), "float32"),
        (("gear",), "discrete", (), "int64"),
        (("speed",), "box", (2,), "float64"),
    ]
    (written,) = make_action_converter(spec)(np.array([[2, 1, 2, 3, 4, 3, 0, 1, 7, -5, 0.05]], np.float32))
    assert list(written) == ["arm", "brake", "gear", "speed"]
    choice, table, grip = written["arm"]
    assert (choice, table.tolist(), grip["grip"].tolist()) == (7, [[2, 2], [3, 2]], [0, 1])
    assert (written["brake"], written["gear"]) == (7, 3)
    assert written["speed"].tolist() == [-0.1, float(np.float32(0.05))]


@pytest.mark.parametrize(
    "space", [spaces.Tuple([]), spaces.Dict({}), spaces.Tuple([spaces.Discrete(2), spaces.Dict({"a": spaces.Tuple([])})])]
)
def test_a_dict_or_tuple_of_no_actions_is_refused(space: Any) -> None:
    with pytest.raises(
        UsageError, match=r"^action space .*: expected at least one space in each Dict and Tuple, got an empty one"
    ):
        action_spec(space)


def test_choices_that_float32_cannot_tell_apart_are_refused() -> None:
    assert action_spec(spaces.Tuple([spaces.Discrete(2**24)])).sizes == (2**24,)
    with pytest.raises(UsageError, match=r"expected at most 16,777,216 choices, got 16,777,217$"):
        action_spec(spaces.Tuple([spaces.Discrete(2), spaces.Discrete(2**24 + 1)]))


def test_actions_are_shifted_to_where_the_space_starts() -> None:
    table = action_spec(ACTIONS["table"])
    assert make_action_converter(table)(np.zeros((1, 2, 2), np.int64)).tolist() == [[[1, 0], [0, -2]]]
    assert make_action_converter(action_spec(ACTIONS["offset"]))(np.array([0, 1, 2])).tolist() == [5, 6, 7]


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_an_action_is_clipped_to_the_exact_bounds_of_its_space(dtype: type[np.floating[Any]]) -> None:
    low, high = np.array([-0.1, -1 / 3, -1e-9]), np.array([0.1, 1 / 3, 0.7])
    space = spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype)
    written = make_action_converter(action_spec(space))(np.array([[-9.0] * 3, [9.0] * 3], np.float32))
    assert written.dtype == dtype
    assert (written == [space.low, space.high]).all()


def test_only_what_is_outside_is_clipped() -> None:
    write = make_action_converter(action_spec(ACTIONS["half"]))  # from 0 up, and from 0 down
    assert write(np.array([[-3, -3], [3, 3], [0.5, -0.5]], np.float32)).tolist() == [[0, -3], [3, 0], [0.5, -0.5]]


@pytest.mark.parametrize("name", UNSUPPORTED_OBSERVATIONS)
def test_an_observation_space_that_is_not_supported_is_one_line(name: str) -> None:
    with pytest.raises(UsageError) as caught:
        spaces_run(observation=name)
    line = str(caught.value)
    assert line.startswith("observation space Text(")
    assert line.endswith(
        "is not supported; supported are Box, Discrete, MultiBinary, MultiDiscrete, and Dict and Tuple of these"
    )
    assert (" at said " in line) is (name == "words")
    assert "\n" not in line


@pytest.mark.parametrize("name", UNSUPPORTED_ACTIONS)
def test_an_action_space_that_is_not_supported_is_one_line(name: str) -> None:
    with pytest.raises(
        UsageError, match=r"^action space .* is not supported; supported are Discrete, MultiDiscrete, .*$"
    ) as caught:
        spaces_run(action=name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("space", [spaces.Box(-1, 1, (0,)), spaces.Box(-1, 1, (2, 0)), spaces.MultiDiscrete([])])
def test_an_action_of_no_numbers_is_refused(space: Any) -> None:
    with pytest.raises(UsageError, match=r"^action space .*: expected at least one number to choose, got shape \[.*0\]$"):
        action_spec(space)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(0, 1, (2,), np.longdouble),
        spaces.Graph(spaces.Discrete(2), None),
        spaces.Sequence(spaces.Discrete(2)),
        spaces.OneOf([spaces.Discrete(2)]),
    ],
    ids=str,
)
def test_observations_without_a_fixed_array_are_refused(space: gymnasium.Space[object]) -> None:
    with pytest.raises(UsageError, match="is not supported"):
        observation_leaves(space)


@pytest.mark.parametrize("page", ["how-to/environments.md", "how-to/vector_env.md", "explanation/limits.md"])
def test_a_page_names_every_space_of_gymnasium_that_is_not_supported(page: str) -> None:
    found = {name for name, kind in vars(spaces).items() if isinstance(kind, type) and issubclass(kind, gymnasium.Space)}
    refused = found - {"Space", "Box", "Discrete", "MultiDiscrete", "MultiBinary", "Dict", "Tuple"}
    text = (Path(__file__).parents[3] / "docs" / page).read_text(encoding="utf-8")
    assert [name for name in sorted(refused) if f"`{name}`" not in text] == []


# ------------------------------------------------------------------------------------------------ what the learner refuses


def altered(observation: str = "box", action_space: str = "discrete", **changes: object) -> str:
    """What `validate` says of a good rollout after these changes."""
    run = run_of(f"{TOY}Spaces-v0", T=6, N=3, kwargs={"observation": observation, "action": action_space})
    (good,) = collect(random_collector(run), run)
    fields = {name: getattr(good, name) for name in good.__struct_fields__} | {
        name: change(getattr(good, name)) for name, change in changes.items() if callable(change)
    }
    with pytest.raises(BadRollout) as caught:
        validate(Rollout(**fields), run, most_steps=100)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def _with(array: Array, at: tuple[int, ...], value: object) -> Array:
    changed = array.copy()
    changed[at] = value
    return changed


def test_a_rollout_that_breaks_the_law_is_refused_in_one_line() -> None:
    assert altered(obs=lambda obs: (obs[0].astype(np.float64),)) == (
        "observation: expected float32[7, 3, 3], got float64[7, 3, 3]; is its environment the same version?"
    )
    assert altered(obs=lambda obs: ()) == "observation: expected 1 arrays, got 0"
    assert altered(reward=lambda a: a[:-1]).startswith("reward: expected float32[6, 3], got float32[5, 3]")
    assert altered(reward=lambda a: _with(a, (2, 1), np.nan)) == "reward: expected finite values, got nan at step 2, copy 1"
    assert (
        altered(log_prob=lambda a: _with(a, (0, 2), -np.inf))
        == "log_prob: expected finite values, got -inf at step 0, copy 2"
    )
    assert (
        altered(obs=lambda o: (_with(o[0], (6, 0, 1), np.inf),))
        == "observation: expected finite values, got inf at step 6, copy 0"
    )
    assert altered(action=lambda a: _with(a, (0, 0), 3)).startswith("action: expected 0 to 2, got 3 at step 0, copy 0")
    assert altered(action=lambda a: _with(a, (0, 0), -1)).startswith("action: expected 0 to 2, got -1 at step 0, copy 0")
    assert altered(lane=lambda _: 8) == "lane: expected 0 to 7, got 8"
    assert altered(valid=lambda a: _with(a, (4, 1), True)) == "valid: expected False at step 4, copy 1, got True"
    assert altered(truncated=lambda a: _with(a, (3, 0), False)) == "valid: expected True at step 4, copy 0, got False"
    assert altered(terminated=lambda a: _with(a, (5, 2), True)) == "episodes: expected 4, got 3"
    assert altered(episodes=lambda e: e[1:]) == "episodes: expected 3, got 2"
    assert altered(valid=lambda a: (a.view(np.uint8) * 3).view(bool)) == "valid: expected bytes 0 and 1, got 3"


def test_values_that_are_not_of_the_space_are_refused() -> None:
    """Else the learner's one-hot features would be indexed out of their bounds."""
    low = altered(observation="discrete", obs=lambda o: (o[0] - 100,))
    assert low.startswith("observation: expected ")
    assert altered(observation="discrete", obs=lambda o: (o[0] + 100,)).startswith("observation: expected ")
    assert altered(observation="multidiscrete", obs=lambda o: (o[0] + 100,)).startswith("observation: expected ")
    assert altered(action_space="multibinary", action=lambda a: a + 2).startswith("action: expected 0 to 1, got ")

    def with_episode(episode: Episode) -> str:
        return altered(episodes=lambda episodes: (episode, *episodes[1:]))

    for impossible in (
        Episode(float("nan"), 1, 1.0), Episode(1.0, 0, 1.0), Episode(1e308, 1, 1.0), Episode(1.0, 10_000, 1.0),
        Episode(1.0, 1, float("nan")), Episode(1.0, 1, -1.0),
    ):  # fmt: skip
        assert with_episode(impossible).startswith("episode: expected a finite return"), impossible
    assert with_episode(Episode(1.0, 1, 1.0, (1.0,))) == "episode: expected 0 facts, got 1"


def test_facts_are_as_many_as_the_run_asks_for_and_finite_or_missing() -> None:
    episode, run = Episode(1.0, 1, 1.0), msgspec.structs.replace(spaces_run(), info_keys=("a", "b"))
    for facts in ((1.0, -1e308), (float("nan"), 0.0)):
        assert wrong_facts(msgspec.structs.replace(episode, facts=facts), run) == ""
    assert wrong_facts(episode, run) == "expected 2 facts, got 0"
    for facts in ((float("inf"), 0.0), (0.0, -float("inf"))):
        assert wrong_facts(msgspec.structs.replace(episode, facts=facts), run).startswith("expected finite facts, got ")
