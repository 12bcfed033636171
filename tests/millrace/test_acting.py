"""`millrace.load`: a saved policy acts as the workers of an evaluation do, bit for bit, and says what it cannot take."""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

import millrace
from millrace.launch.policy_workers import PlayingWorkers, policy_player
from millrace.learner.config.layers import resolve
from millrace.learner.policy_player import saved_policy
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.arrays import Array
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.env_actions import make_action_converter
from millrace.protocol.envs.spaces import action_spec, make_flatten, make_unflatten, observation_leaves
from millrace.protocol.errors import UsageError
from millrace.protocol.messages import EpisodeRows
from millrace.protocol.specs import PolicySpec, RunSpec
from tests.support.in_process.collectors import TOY, random_weights, run_of
from tests.support.users_code.mask_envs import SIZES, Parts

STEPS = 30


def folder_of(run: RunSpec, tmp_path: Path, which: Any = "final", scale: float = 1.0) -> Path:
    """A run folder with random weights."""
    parameters, buffers = random_weights(run.policy)
    folder = RunFolder.create(resolve(run.env.id, run_dir=str(tmp_path)))
    folder.write_policy(run, (parameters * np.float32(scale)).astype(np.float32), buffers, which)
    return folder.path


def silent(text: str) -> None:
    """Shows nothing."""


def played(run: Path, copies: int, *, greedy: bool = True, seed: int = 3) -> list[tuple[list[Array], Array]]:
    """What workers of an evaluation saw and did: for each episode the leaves [L+1, *leaf], and actions [L, *action]."""
    rows: list[list[EpisodeRows]] = [[] for _ in range(copies)]
    plan = EvaluationPlan(tuple(seed + n for n in range(copies)), copies, STEPS, greedy=greedy, send_rows=True)
    saved = saved_policy(run)
    with policy_player(saved, PlayingWorkers(1, "inproc"), silent) as player:
        player.play(plan, lambda episode, some: rows[episode].append(some))
    to_env = make_action_converter(saved.card.policy.action)
    leaves = range(len(saved.card.policy.observation))
    return [
        (
            [np.concatenate([some.obs[i][bool(n) :] for n, some in enumerate(one)]) for i in leaves],
            np.asarray(to_env(np.concatenate([some.action for some in one]))),
        )
        for one in rows
    ]


def observations(episodes: Sequence[tuple[list[Array], Array]], t: int, unflatten: Any) -> Any:
    """The batch at step t. Of an episode that has ended, its last observation."""
    count = range(len(episodes[0][0]))
    return unflatten([np.stack([leaves[i][min(t, len(leaves[i]) - 1)] for leaves, _ in episodes]) for i in count])


POLICIES: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    "discrete": ("CartPole-v1", {}, {}),
    "box, normalized": ("Pendulum-v1", {}, {"normalize_observations": True}),
    "images": (f"{TOY}Frames-v0", {}, {}),
    "lstm": ("CartPole-v1", {}, {"core": "lstm", "core_size": 8}),
    "gru": ("Pendulum-v1", {}, {"core": "gru", "core_size": 8, "normalize_observations": True}),
    "action values": ("CartPole-v1", {}, {"head": "q"}),
    "action values, gru": ("CartPole-v1", {}, {"head": "q", "core": "gru", "core_size": 8}),
    "images, action values, lstm": (f"{TOY}Frames-v0", {}, {"head": "q", "core": "lstm", "core_size": 8}),
    "dict": (f"{TOY}Spaces-v0", {"observation": "dict", "action": "multidiscrete"}, {}),
    "tuple": (f"{TOY}Spaces-v0", {"observation": "tuple", "action": "multibinary"}, {}),
    "nested": (f"{TOY}Spaces-v0", {"observation": "nested", "action": "offset"}, {}),
    "doubles": (f"{TOY}Spaces-v0", {"observation": "unbounded", "action": "half"}, {}),
    "mixed": (f"{TOY}Spaces-v0", {"action": "mixed"}, {}),
}


@pytest.mark.parametrize("copies", [1, 4])
@pytest.mark.parametrize("name", POLICIES)
def test_it_acts_as_an_evaluation_does_bit_for_bit(name: str, copies: int, tmp_path: Path) -> None:
    env, kwargs, settings = POLICIES[name]
    run = run_of(env, kwargs=kwargs, **settings)
    folder = folder_of(run, tmp_path)
    made = run.env.make()
    unflatten = make_unflatten(made.observation_space)
    parts = make_flatten(made.action_space)
    episodes = played(folder, copies)
    policy = millrace.load(folder)
    policy.reset(copies)
    compared = 0
    for t in range(max(len(actions) for _, actions in episodes)):
        batch = observations(episodes, t, unflatten)
        got = policy(batch)
        for n, (_, actions) in enumerate(episodes):
            if t < len(actions):
                for ours, theirs in zip(parts(got), parts(actions[t]), strict=True):
                    assert ours[n].tobytes() == theirs.tobytes(), (t, n)
                    assert ours[n].dtype == theirs.dtype
                compared += 1
    assert compared > 2 * copies


def test_its_vectors_are_those_that_a_rollout_service_publishes(tmp_path: Path) -> None:
    run = run_of("Pendulum-v1", normalize_observations=True)
    policy = millrace.load(folder_of(run, tmp_path))
    service = millrace.PolicyParameters(policy.spec)
    parameters, buffers = random_weights(run.policy)
    assert np.array_equal(service.flat(policy.parameters), parameters)
    assert np.array_equal(service.flat_buffers(policy.buffers), buffers)


def test_one_observation_gives_one_action_that_the_environment_takes(tmp_path: Path) -> None:
    run = run_of("Pendulum-v1")
    folder = folder_of(run, tmp_path)
    ((leaves, actions),) = played(folder, 1)
    policy = millrace.load(folder)
    assert [policy(obs).tobytes() for obs in leaves[0][:-1]] == [action.tobytes() for action in actions]
    assert run.env.make().action_space.contains(policy(leaves[0][0]))


def test_one_action_of_a_dict_is_a_dict_that_the_environment_takes(tmp_path: Path) -> None:
    run = run_of(f"{TOY}Spaces-v0", kwargs={"action": "mixed"})
    policy = millrace.load(folder_of(run, tmp_path))
    env = run.env.make()
    observation, _ = env.reset(seed=1)
    for _ in range(4):
        observation, _, _, ended, _ = env.step(policy(observation))  # it raises for an action outside its space
    assert ended


def test_sampled_actions_are_those_of_a_recording_with_the_same_seed(tmp_path: Path) -> None:
    folder = folder_of(run_of("CartPole-v1"), tmp_path)
    policy = millrace.load(folder, deterministic=False, seed=0)
    for seed in (3, 8):
        ((leaves, actions),) = played(folder, 1, greedy=False, seed=seed)
        policy.reset(seed=seed)
        assert [int(policy(obs)) for obs in leaves[0][:-1]] == actions.tolist()
    greedy = millrace.load(folder)
    assert [int(greedy(obs)) for obs in leaves[0][:-1]] != actions.tolist()


def test_the_same_seed_samples_the_same_actions(tmp_path: Path) -> None:
    folder, batch = folder_of(run_of("CartPole-v1"), tmp_path), np.zeros((64, 4), np.float32)
    one, same, other = (millrace.load(folder, deterministic=False, seed=seed)(batch).tolist() for seed in (1, 1, 2))
    assert one == same
    assert one != other


def test_the_best_policy_is_another_file(tmp_path: Path) -> None:
    run = run_of("Pendulum-v1")
    folder = folder_of(run, tmp_path)
    with pytest.raises(millrace.UsageError, match=r"expected the best policy, best\.safetensors, got none"):
        millrace.load(folder, best=True)
    parameters, buffers = random_weights(run.policy)
    RunFolder.open(folder).write_policy(run, -parameters, buffers, "best")
    obs = np.array([1.0, 0.0, 0.5], np.float32)
    assert millrace.load(folder, best=True)(obs) != millrace.load(folder)(obs)


def test_a_recurrent_policy_says_that_it_must_be_reset_first_and_how(tmp_path: Path) -> None:
    policy = millrace.load(folder_of(run_of("CartPole-v1", core="lstm", core_size=8), tmp_path))
    with pytest.raises(millrace.UsageError, match=r"recurrent: call reset\(3\) before the first observation"):
        policy(np.zeros((3, 4)))
    policy.reset(2)
    with pytest.raises(millrace.UsageError, match="expected 2 observations, as in reset, got 3"):
        policy(np.zeros((3, 4)))
    with pytest.raises(millrace.UsageError, match="reset: copies: expected int >= 1, got 0"):
        policy.reset(0)


def test_first_begins_an_episode_in_these_copies_only(tmp_path: Path) -> None:
    run = run_of("Pendulum-v1", core="gru", core_size=8)
    policy, obs = millrace.load(folder_of(run, tmp_path)), np.array([[0.5, -0.5, 2.0], [1.0, 0.0, -1.0]], np.float32)
    policy.reset(2)
    begun, later = policy(obs), policy(obs)
    with pytest.raises(millrace.UsageError, match=r"first: expected a bool, or \[2\] of them, got shape \[3\]"):
        policy(obs, first=[True] * 3)
    third = policy(obs, first=[True, False])
    assert third[0] == begun[0]
    assert third[1] != begun[1]
    assert not np.array_equal(later, begun), "the state has an effect"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.zeros(5), r"observation: expected float32\[4\], or \[n, …\] of them, got float64\[5\]"),
        (np.zeros((2, 3, 4)), r"got float64\[2, 3, 4\]"),
        ([[0.0] * 4, [0.0] * 3], "observation: expected"),
        (np.full(4, np.nan), "observation: expected finite values, got"),
        (np.full(4, 1e300), "observation: expected finite values, got"),
        (["a"] * 4, "observation: expected"),
        ({"x": np.zeros(4)}, "observation: expected"),
    ],
)
def test_what_is_no_observation_is_refused_in_one_line(given: Any, message: str, tmp_path: Path) -> None:
    policy = millrace.load(folder_of(run_of("CartPole-v1"), tmp_path))
    with pytest.raises(millrace.UsageError, match=message) as caught:
        policy(given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("given", "wrong"), [(16, 16), (-1, -1), ([3, 16], 16)])
def test_a_number_that_is_not_in_the_space_is_refused(given: Any, wrong: int, tmp_path: Path) -> None:
    policy = millrace.load(folder_of(run_of("FrozenLake-v1"), tmp_path))
    assert policy([0, 15]).shape == (2,)
    with pytest.raises(millrace.UsageError, match=f"observation: expected 0 to 15, got {wrong}"):
        policy(given)


def test_a_part_of_a_dict_that_is_missing_or_of_another_number_is_named(tmp_path: Path) -> None:
    run = run_of(f"{TOY}Spaces-v0", kwargs={"observation": "dict", "action": "discrete"})
    policy = millrace.load(folder_of(run, tmp_path))
    whole = run.env.make().observation_space.sample()
    assert isinstance(whole, dict)
    assert policy(whole).shape == ()
    assert policy({**whole, "more": 1}).shape == (), "what the policy does not use is ignored"
    name = next(iter(whole))
    with pytest.raises(millrace.UsageError, match=f"^<.*{policy.run}.*>: observation: expected {name}"):
        policy({key: value for key, value in whole.items() if key != name})
    with pytest.raises(millrace.UsageError, match=f"observation: expected {name}, got one array$"):
        policy(whole[name])
    with pytest.raises(millrace.UsageError, match="for the same number of env copies, got different ones"):
        policy({**whole, name: _stacked(whole[name])})


def _stacked(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(np.stack([part, part]) for part in value)
    if isinstance(value, dict):
        return {key: np.stack([part, part]) for key, part in value.items()}
    return np.stack([value, value])


def test_acting_imports_neither_torch_nor_an_environment_nor_an_algorithm(tmp_path: Path) -> None:
    folder = folder_of(run_of("CartPole-v1"), tmp_path)
    program = (
        f"import sys, numpy, millrace; policy = millrace.load({str(folder)!r}); policy(numpy.zeros(4)); "
        "assert not sys.modules.keys() & {'torch', 'cloudpickle', 'millrace.learner.algorithms.algorithm', "
        "'gymnasium.envs.classic_control', 'millrace.workers.worker'}"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


@pytest.mark.parametrize(
    ("env", "wrappers"),
    [
        ("__main__:Mine", ()),  # a class of the script that trained it
        ("<lambda>", ()),
        ("CartPole-v1", ("__main__:Clip",)),
        ("CartPole-v1", ("<Clip>",)),
        ("not_installed_here:Mine-v0", ("nor_this:Clip",)),
    ],
)
def test_it_needs_neither_the_environment_nor_the_wrappers(env: str, wrappers: tuple[str, ...], tmp_path: Path) -> None:
    run = run_of("CartPole-v1")
    elsewhere = msgspec.structs.replace(run, env=EnvSpec(env, wrappers=wrappers))
    policy = millrace.load(folder_of(elsewhere, tmp_path / "elsewhere"))
    here = millrace.load(folder_of(run, tmp_path / "here"))
    seen = np.linspace(-0.1, 0.1, 12, dtype=np.float32).reshape(3, 4)
    assert policy(seen).tolist() == here(seen).tolist()
    assert repr(policy).startswith(f"<{env}, newest policy of ")


def test_a_copy_of_the_two_files_is_enough(tmp_path: Path) -> None:
    run = folder_of(run_of("CartPole-v1"), tmp_path)
    copy = tmp_path / "copy"
    copy.mkdir()
    for name in ("policy.json", "policy.safetensors"):
        shutil.copy(run / name, copy)
    batch = np.random.default_rng(0).normal(size=(16, 4)).astype(np.float32)
    np.testing.assert_array_equal(millrace.load(copy)(batch), millrace.load(run)(batch))
    (copy / "policy.json").unlink()
    with pytest.raises(millrace.UsageError, match=r"expected a run folder, got one without config\.toml"):
        millrace.load(copy)


def masked_policy(tmp_path: Path, sizes: Sequence[int] = (3, 3)) -> millrace.LoadedPolicy:
    """A policy with masks, for a Dict observation of one number and MultiDiscrete actions."""
    observation, action = spaces.Dict(x=spaces.Box(0, 1, (1,), np.float32)), spaces.MultiDiscrete(list(sizes))
    policy = PolicySpec(observation_leaves(observation), action_spec(action))
    return millrace.load(
        folder_of(RunSpec(EnvSpec("Doors-v0"), policy, 8, copies=1, lanes=1, seed=1, masked=True), tmp_path)
    )


MASKS_OF_ENTRIES = np.eye(3, dtype=np.int8)[[[2, 0], [1, 1], [0, 2], [2, 2]]]  # [n, entries, choices], one choice each


def in_objects(masks: Any) -> Any:
    """An array of objects, each a tuple with one mask for each entry: what a vector environment has in its infos."""
    objects = np.empty(len(masks), object)
    for n, mask in enumerate(masks):
        objects[n] = tuple(mask)
    return objects


@pytest.mark.parametrize("n", [1, 2, 3, 4])
@pytest.mark.parametrize(
    "form",
    [
        lambda masks: masks.reshape(len(masks), -1),
        lambda masks: masks,
        lambda masks: list(masks),
        lambda masks: list(masks.reshape(len(masks), -1)),
        lambda masks: tuple(masks[:, entry] for entry in range(2)),
        in_objects,
        lambda masks: list(in_objects(masks)),
        lambda masks: tuple(in_objects(masks)),
        lambda masks: tuple(masks.tolist()),
    ],
    ids=[
        "rows",
        "an array",
        "a list",
        "a list of rows",
        "a tuple of entries",
        "objects",
        "a list of tuples",
        "a tuple of tuples",
        "a tuple of lists",
    ],
)
def test_masks_of_a_batch_may_have_each_form_that_environments_give_them(n: int, form: Any, tmp_path: Path) -> None:
    policy = masked_policy(tmp_path)
    masks = MASKS_OF_ENTRIES[:n]
    expected = masks.argmax(-1).tolist()
    seen = np.zeros((n, 1), np.float32)
    assert policy({"x": seen}, mask=form(masks)).tolist() == expected
    assert policy({"x": seen, "action_mask": form(masks)}).tolist() == expected


@pytest.mark.parametrize("convert", [tuple, list, np.stack])
@pytest.mark.parametrize("n", [2, 3, 4])
def test_a_mask_for_each_copy_may_be_one_array_even_if_there_are_as_many_copies_as_choices(
    n: int, convert: Any, tmp_path: Path
) -> None:
    policy = masked_policy(tmp_path, sizes=(3,))
    chosen = [2, 0, 2, 1][:n]
    masks = convert([np.eye(3, dtype=np.int8)[choice] for choice in chosen])
    assert policy({"x": np.zeros((n, 1), np.float32)}, mask=masks).tolist() == [[choice] for choice in chosen]


def test_a_mask_without_a_choice_is_refused_and_the_error_names_the_observation(tmp_path: Path) -> None:
    """Vector environments of gymnasium return zeros for copies without a mask."""
    policy = masked_policy(tmp_path)
    masks = [[1, 1, 1, 1, 1, 1], [0, 0, 0, 0, 0, 0], [1, 1, 1, 1, 0, 0], [1, 1, 1, 0, 0, 0]]
    expected = r"^mask: expected an allowed choice for each entry of the action, got none for observations \[1, 3\]; "
    with pytest.raises(UsageError, match=expected + "if copies have no mask .* pass ones"):
        policy({"x": np.zeros((4, 1), np.float32)}, mask=masks)


@pytest.mark.parametrize("convert", [lambda masks: masks, list, tuple], ids=["as they are", "a list", "a tuple"])
@pytest.mark.parametrize("n", [1, len(SIZES), 4])
def test_the_masks_of_a_vector_environment_may_have_entries_of_different_sizes(n: int, convert: Any, tmp_path: Path) -> None:
    envs = SyncVectorEnv([Parts] * n)
    spec = PolicySpec(observation_leaves(Parts.observation_space), action_spec(Parts.action_space))
    policy = millrace.load(
        folder_of(RunSpec(EnvSpec("Parts-v0"), spec, 8, copies=1, lanes=1, seed=1, masked=True), tmp_path)
    )
    for seed in range(5):
        observation, infos = envs.reset(seed=seed)
        envs.step(policy(observation, mask=convert(infos["action_mask"])))  # raises for an action that isn't allowed
    envs.close()


@pytest.mark.parametrize("sizes", [(3, 3), (3, 2)])
@pytest.mark.parametrize("kind", [tuple, list, np.concatenate])
def test_a_mask_for_one_observation_may_be_a_sequence_with_one_for_each_entry(
    sizes: tuple[int, int], kind: Any, tmp_path: Path
) -> None:
    policy = masked_policy(tmp_path, sizes)
    mask = kind([np.eye(size, dtype=bool)[1] for size in sizes])
    one, several = {"x": np.zeros(1, np.float32)}, {"x": np.zeros((3, 1), np.float32)}
    assert policy(one, mask=mask).tolist() == [1, 1]
    assert policy(several, mask=mask).tolist() == [[1, 1]] * 3
    with pytest.raises(UsageError, match=rf"mask: expected {sum(sizes)} zeros and ones .*, got .*bool\[2\]"):
        policy(one, mask=(*mask[:-1], np.ones(2, bool), np.ones(2, bool)))
