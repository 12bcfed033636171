"""The results of the vector environment are bit for bit those of gymnasium's SyncVectorEnv, for every transport."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from copy import deepcopy
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import vector as wrappers
from hypothesis import given, settings
from hypothesis import strategies as st

import millrace
from millrace.cli.status import as_table, ask, observer_name
from millrace.learner.vector_env.env import ZmqVectorEnv
from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.protocol.errors import EnvironmentFailed, UsageError
from millrace.protocol.wire.worker_link import WorkerLink
from tests.support.gymnasium_versions import TAXI, needs_listed_episodes
from tests.support.in_process.rows_of_copies import Row, info_of, of_copies, received
from tests.support.numbers.bit_equality import bit_equal
from tests.support.variants import variants

MODES = tuple(AutoresetMode)
TRANSPORTS: dict[str, dict[str, Any]] = {
    "shared": {},
    "ipc": {"shared_memory": False},
    "tcp": {"shared_memory": False, "transport": "tcp"},
    "inproc": {"transport": "inproc"},
}
CASES: dict[str, dict[str, Any]] = {
    "CartPole-v1": {},
    "Pendulum-v1": {"max_episode_steps": 30},
    TAXI: {"max_episode_steps": 20},
    "tests.support.envs.toy:Informs-v0": {},
    "tests.support.envs.toy:Spaces-v0": {"observation": "nested", "action": "table"},
}


@contextmanager
def both(
    env: str, num_envs: int, mode: AutoresetMode, transport: str, workers: int = 2, **kwargs: Any
) -> Iterator[tuple[ZmqVectorEnv, SyncVectorEnv[Any, Any]]]:
    """Our vector environment, and gymnasium's SyncVectorEnv in this process."""
    with ExitStack() as stack:
        ours = millrace.make_vec(
            env, num_envs, workers=workers, autoreset_mode=mode, timeout=20, **TRANSPORTS[transport], **kwargs
        )
        stack.callback(ours.close)
        theirs = SyncVectorEnv(
            [lambda: gymnasium.make(env, disable_env_checker=True, **kwargs) for _ in range(num_envs)], autoreset_mode=mode
        )
        stack.callback(theirs.close)
        yield ours, theirs


def play(ours: ZmqVectorEnv, theirs: SyncVectorEnv[Any, Any], steps: int, mode: AutoresetMode) -> None:
    """Step both with the same seeds and actions, and compare the results."""
    assert bit_equal(ours.reset(seed=7), theirs.reset(seed=7))
    theirs.action_space.seed(3)
    for t in range(steps):
        action = theirs.action_space.sample()
        mine, wanted = ours.step(action), theirs.step(action)
        assert bit_equal(mine, wanted), f"step {t}: {mine} is not {wanted}"
        ended = wanted[2] | wanted[3]
        if mode is AutoresetMode.DISABLED and ended.any():
            options = [{"reset_mask": ended.copy()} for _ in range(2)]
            assert bit_equal(ours.reset(options=options[0]), theirs.reset(options=options[1]))


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.value)
@pytest.mark.parametrize("env", variants(CASES, default=["tests.support.envs.toy:Informs-v0"]))
def test_results_through_shared_memory_equal_those_of_sync_vector_env(env: str, mode: AutoresetMode) -> None:
    with both(env, 5, mode, "shared", **CASES[env]) as (ours, theirs):
        play(ours, theirs, 500 if env == "CartPole-v1" else 200, mode)


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.value)
@pytest.mark.parametrize("transport", variants(["ipc", "tcp", "inproc"], default=["inproc"]))
def test_results_by_messages_equal_those_of_sync_vector_env(transport: str, mode: AutoresetMode) -> None:
    with both("tests.support.envs.toy:Informs-v0", 5, mode, transport) as (ours, theirs):
        play(ours, theirs, 150, mode)


def test_its_attributes_equal_those_of_sync_vector_env() -> None:
    with both("CartPole-v1", 3, AutoresetMode.SAME_STEP, "inproc") as (ours, theirs):
        assert isinstance(ours, VectorEnv)
        for name in ("num_envs", "observation_space", "action_space", "single_observation_space", "single_action_space"):
            assert getattr(ours, name) == getattr(theirs, name)
        assert ours.metadata == theirs.metadata
        assert ours.autoreset_mode is theirs.autoreset_mode
        assert ours.get_attr("spec") == (gymnasium.make("CartPole-v1").spec,) * 3, "with the checker, as it is registered"
        for name in ("observation_space", "action_space"):
            assert ours.get_attr(name) == theirs.get_attr(name)
            assert ours.call(name) == theirs.call(name)
        assert ours.render_mode is None
        assert repr(ours) == "ZmqVectorEnv(CartPole-v1, num_envs=3)"
        assert ours.unwrapped is ours


def seeded(seed: int) -> gymnasium.Env[Any, Any]:
    """As in the scripts of CleanRL."""
    env = gymnasium.make("Pendulum-v1")
    env.action_space.seed(seed)
    return env


def test_a_space_that_a_factory_seeds_has_the_samples_of_sync_vector_env() -> None:
    makes = [partial(seeded, 3 + n) for n in range(2)]
    ours, theirs = millrace.make_vec(makes, transport="inproc"), SyncVectorEnv(makes)
    for space in ("single_action_space", "action_space"):
        for _ in range(3):
            assert bit_equal(getattr(ours, space).sample(), getattr(theirs, space).sample())
    ours.close()
    theirs.close()


def test_calls_and_attributes() -> None:
    with both("tests.support.envs.toy:Informs-v0", 5, AutoresetMode.NEXT_STEP, "shared") as (ours, theirs):
        assert ours.get_attr("level") == theirs.get_attr("level") == (1,) * 5
        for env in (ours, theirs):
            env.reset(seed=1)
            env.set_attr("level", [1, 2, 3, 4, 5])
        assert bit_equal(ours.get_attr("level"), theirs.get_attr("level"))
        assert ours.call("shout", "hm", times=2) == theirs.call("shout", "hm", times=2)
        assert ours.calls.call([1, 4], "level", (), {}) == (2, 5)
        assert bit_equal(ours.np_random_seed, theirs.np_random_seed)
        with pytest.raises(AttributeError, match="no_such_thing"):
            ours.get_attr("no_such_thing")
        with pytest.raises(EnvironmentFailed, match="expected plain data") as raised:
            ours.get_attr("unwrapped")
        assert "Traceback" in raised.value.detail
        with pytest.raises(ValueError, match="use reset"):
            ours.call("reset")
        theirs.action_space.seed(3)
        action = theirs.action_space.sample()
        assert bit_equal(ours.step(action), theirs.step(action))  # the calls did not disturb it


def test_workers_render_frames() -> None:
    with millrace.make_vec("CartPole-v1", 2, workers=1, render_mode="rgb_array") as env:
        env.reset(seed=1)
        frames = env.render()
        assert env.render_mode == "rgb_array"
        assert [frame.shape for frame in frames] == [(400, 600, 3)] * 2


def test_a_callable_and_a_list_of_environments() -> None:
    def countdown(k: int) -> Any:
        return lambda: gymnasium.make("tests.support.envs.toy:Countdown-v0", k=k)

    with millrace.make_vec([countdown(2), countdown(3), "tests.support.envs.toy:Countdown-v0"], workers=2) as env:
        assert env.num_envs == 3
        env.reset()
        ended = [env.step(np.zeros(3, np.int64))[2].tolist() for _ in range(3)]
        assert ended == [[False, False, False], [True, False, False], [False, True, False]]


def test_actions_of_another_dtype_are_not_converted() -> None:
    """For a float64 action in a float32 space, rounding would change the bits of all later observations."""
    with both("Pendulum-v1", 3, AutoresetMode.NEXT_STEP, "shared") as (ours, theirs):
        ours.reset(seed=1), theirs.reset(seed=1)
        rng = np.random.default_rng(1)
        for _ in range(20):
            action = rng.uniform(-2, 2, (3, 1))
            assert bit_equal(ours.step(action), theirs.step(action))


def test_observations_are_copies_unless_copy_is_false() -> None:
    zeros = np.zeros(2, np.int64)
    with millrace.make_vec("CartPole-v1", 2, workers=1) as env:
        first, _ = env.reset(seed=1)
        kept = first.copy()
        env.step(zeros)
        assert (first == kept).all()
    with millrace.make_vec("CartPole-v1", 2, workers=1, copy=False) as env:
        first, _ = env.reset(seed=1)
        kept = first.copy()
        second = env.step(zeros)[0]
        assert (first == second).all()
        assert (first != kept).any()


@needs_listed_episodes
def test_gymnasium_vector_wrappers_work_on_it() -> None:
    def wrapped(env: VectorEnv[Any, Any, Any]) -> VectorEnv[Any, Any, Any]:
        env = wrappers.RecordEpisodeStatistics(env)
        env = wrappers.NormalizeObservation(env)
        env = wrappers.ClipReward(env, -0.5, 0.5)
        return wrappers.DictInfoToList(env)

    with both("CartPole-v1", 4, AutoresetMode.NEXT_STEP, "shared") as (ours, theirs):
        mine, other = wrapped(ours), wrapped(theirs)
        a, b = mine.reset(seed=2), other.reset(seed=2)
        assert bit_equal(a[0], b[0])
        ended = 0
        for t in range(200):
            action = np.random.default_rng(t).integers(0, 2, 4)
            (*row, infos), (*their_row, their_infos) = mine.step(action), other.step(action)
            assert bit_equal(row, their_row)
            returns = [info.get("episode", {}).get("r") for info in infos]  # type: ignore[attr-defined]
            assert returns == [info.get("episode", {}).get("r") for info in their_infos]  # type: ignore[attr-defined]
            ended += sum(one is not None for one in returns)
        assert ended > 10


def test_an_info_that_is_no_plain_data_arrives_as_its_repr_with_one_warning(caplog: pytest.LogCaptureFixture) -> None:
    with (
        caplog.at_level(logging.WARNING, "millrace.learner"),
        millrace.make_vec("tests.support.envs.toy:Informs-v0", 2, workers=1, odd=True) as env,
    ):
        env.reset(seed=1)
        action = env.action_space.sample()
        for _ in range(3):
            infos = env.step(action)[4]
        assert infos["odd"].tolist() == ["<odd>", "<odd>"]
    assert [record.message for record in caplog.records].count(
        "info odd of row 0 is not plain data: it arrives as its repr, a string"
    ) == 1


def test_infos_too_long_for_shared_memory_are_sent_as_a_message() -> None:
    with both("tests.support.envs.toy:Informs-v0", 2, AutoresetMode.NEXT_STEP, "shared", wordy=1_000_000) as (ours, theirs):
        play(ours, theirs, 5, AutoresetMode.NEXT_STEP)
        assert len(ours.step(ours.action_space.sample())[4]["word"][0]) > 1_000_000


def test_a_status_request_is_answered_while_it_steps() -> None:
    zeros = np.zeros(3, np.int64)
    with millrace.make_vec("CartPole-v1", 3, workers=2) as env, ThreadPoolExecutor(1) as pool:
        env.reset(seed=1)
        link = WorkerLink(env.address, observer_name())
        reply = pool.submit(ask, link, 20.0)
        while not reply.done():
            env.step(zeros)
        link.close(0)
        status = reply.result()
    assert (status.env, status.progress.total_steps) == ("CartPole-v1", 0)
    assert [(worker.worker, worker.lanes) for worker in sorted(status.workers, key=lambda one: one.worker)] == [
        ("w0", (0,)),
        ("w1", (1,)),
    ]
    assert "CartPole-v1, a vector environment: " in as_table(status)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"num_envs": 0}, "num_envs: expected at least 1"),
        ({"lanes": 9}, "lanes: expected 1 to num_envs"),
        ({"lanes": 0}, "lanes: expected 1 to num_envs"),
        ({"bind": "tcp://127.0.0.1:*"}, "workers: expected 0, got "),
        ({"workers": None, "bind": "tcp://127.0.0.1:*", "insecure": True, "env": lambda: None}, "factory"),
        ({"workers": None, "bind": "tcp://0.0.0.0:*", "insecure": True, "keys": "k"}, "got both"),
        ({"workers": None, "bind": "tcp://0.0.0.0:*", "advertise": "host:7"}, "expected an IPv6 address in brackets"),
        ({"autoreset_mode": "Never"}, "autoreset_mode: expected"),
        ({"observation_mode": "other"}, "observation_mode: expected one of same, different or a tuple, got 'other'"),
        ({"observation_mode": (1, 2)}, "observation_mode: expected the spaces of the batch and of a single copy, got "),
        ({"timeout": 0}, "^timeout: expected a number of seconds above 0, got 0$"),
        ({"timeout": -1.0}, "^timeout: expected a number of seconds above 0, got -1.0$"),
        ({"timeout": float("nan")}, "^timeout: expected a number of seconds above 0, got nan$"),
        ({"env": "NoSuchEnv-v7"}, "is not registered"),
        ({"env": "FrozenLake-v1", "desc": ["SF", "FG"]}, r"make_vec: desc: expected .*, got \['SF', 'FG'\]"),
        ({"env": "tests.support.envs.toy:Spaces-v0", "observation": "text"}, "is not supported"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        millrace.make_vec(**{"env": "CartPole-v1", "num_envs": 2, "workers": 1, **wrong})


def test_calls_in_the_wrong_order_raise_the_errors_of_gymnasium() -> None:
    zeros = np.zeros(2, np.int64)
    with millrace.make_vec("CartPole-v1", 2, transport="inproc", autoreset_mode="Disabled") as env:
        with pytest.raises(UsageError, match="call reset"):
            env.step(zeros)
        env.reset(seed=1)
        with pytest.raises(gymnasium.error.NoAsyncCallError):
            env.step_wait()
        env.step_async(zeros)
        with pytest.raises(gymnasium.error.AlreadyPendingCallError):
            env.step_async(zeros)
        with pytest.raises(gymnasium.error.AlreadyPendingCallError):
            env.reset()
        env.step_wait()
        with pytest.raises(UsageError, match="have ended"):
            for _ in range(50):
                env.step(zeros)
        for mask, error in ([True, False], TypeError), (np.zeros(2, bool), ValueError), (np.ones(3, bool), ValueError):
            with pytest.raises(error):
                env.reset(options={"reset_mask": mask})
        with pytest.raises(ValueError, match="seed: expected one for each"):
            env.reset(seed=[1])
        with pytest.raises(ValueError, match="actions: expected one for each"):
            env.reset(), env.step(np.zeros(3, np.int64))
    env.close()
    with pytest.raises(gymnasium.error.ClosedEnvironmentError):
        env.reset()


def test_arguments_that_no_message_can_carry_are_refused_before_anything_is_sent() -> None:
    zeros = np.zeros(2, np.int64)
    with millrace.make_vec("CartPole-v1", 2, transport="inproc", timeout=20) as env:
        wanted = env.reset(seed=1)
        for seed in 2**64 - 1, [1, 2**64]:
            with pytest.raises(ValueError, match="seed: expected whole numbers of at most 64 bits, got 184467440737095516"):
                env.reset(seed=seed)
        names: list[Any] = ["x" * 1001, "a\nb", "a\udc80", "", 5]
        for name in names:
            for use in partial(env.call, name), partial(env.get_attr, name), partial(env.set_attr, name, 1):
                with pytest.raises(UsageError, match=r"^call: expected the name of an attribute, text of 1 to 1,000 char"):
                    use()
        with pytest.raises(TypeError, match=r"got text with a lone surrogate$"):
            env.call("has_wrapper_attr", "a\udc80")
        with pytest.raises(TypeError, match="actions: expected numbers of at most 64 bits, got float128"):
            env.step(zeros.astype(np.longdouble))
        result = env.step(zeros.astype(">i8"))
        assert bit_equal(env.reset(seed=1), wanted)
        assert bit_equal(env.step(zeros), result)


seeds = st.none() | st.integers(0, 9) | st.lists(st.none() | st.integers(0, 9), min_size=3, max_size=3)
options = st.none() | st.dictionaries(st.sampled_from(["why", "how"]), st.text(max_size=3) | st.integers(-3, 3), max_size=2)
masks = st.lists(st.booleans(), min_size=3, max_size=3).filter(any)
ATTRIBUTES = ["level", "np_random_seed"]
if gymnasium.__version__ >= "1.4":  # before, SyncVectorEnv writes its autoreset mode into the metadata of its copies' class
    ATTRIBUTES.append("metadata")
calls = st.lists(
    st.one_of(
        st.tuples(st.just("step"), st.integers(1, 4)),
        st.tuples(st.just("step_async"), st.none()),
        st.tuples(st.just("send"), st.tuples(st.permutations([(0, 1), (2,)]), st.integers(0, 3))),
        st.tuples(st.sampled_from(["reset", "reset_async"]), st.tuples(seeds, options)),
        st.tuples(st.just("mask"), st.tuples(seeds, options, masks)),
        st.tuples(st.just("call"), st.tuples(st.text(max_size=3), st.integers(0, 2))),
        st.tuples(st.just("set_attr"), st.integers(-3, 3) | st.lists(st.integers(-3, 3), min_size=3, max_size=3)),
        st.tuples(st.just("get_attr"), st.sampled_from(ATTRIBUTES)),
        st.tuples(st.just("render"), st.none()),
    ),
    max_size=15,
)


def test_any_sequence_of_calls_gives_the_results_of_sync_vector_env() -> None:
    """Through shared memory and by messages, in each autoreset mode; results are compared after every call."""
    with ExitStack() as stack:
        pairs = {
            (mode, transport): stack.enter_context(both("tests.support.envs.toy:Informs-v0", 3, mode, transport))
            for mode in MODES
            for transport in ("shared", "inproc")
        }

        @settings(max_examples=120, deadline=None)
        @given(st.sampled_from(sorted(pairs, key=str)), st.integers(0, 1000), calls)
        def any_sequence(pair: tuple[AutoresetMode, str], seed: int, sequence: list[tuple[str, Any]]) -> None:
            play_sequence(*pairs[pair], pair[0], seed, sequence)

        any_sequence()


def play_sequence(
    ours: ZmqVectorEnv, theirs: SyncVectorEnv[Any, Any], mode: AutoresetMode, seed: int, sequence: list[tuple[str, Any]]
) -> None:
    def same(name: str, *args: Any, **keywords: Any) -> Any:
        mine, wanted = (getattr(env, name)(*args, **deepcopy(keywords)) for env in (ours, theirs))
        assert bit_equal(mine, wanted), f"{name}: {mine} is not {wanted}"
        return wanted

    theirs.action_space.seed(seed)
    same("reset", seed=seed)
    same("set_attr", "level", 1)
    ended = np.zeros(3, bool)
    for kind, value in sequence:
        match kind:
            case "step" | "step_async":
                for _ in range(value or 1):
                    if mode is AutoresetMode.DISABLED and ended.any():
                        same("reset", options={"reset_mask": ended, "why": "ended"})
                    action = theirs.action_space.sample()
                    if kind == "step_async":
                        ours.step_async(action)
                        mine, wanted = ours.step_wait(), theirs.step(action)
                        assert bit_equal(mine, wanted), f"{mine} is not {wanted}"
                    else:
                        wanted = same("step", action)
                    ended = wanted[2] | wanted[3]
            case "send":
                if mode is AutoresetMode.DISABLED and ended.any():
                    same("reset", options={"reset_mask": ended, "why": "ended"})
                action = theirs.action_space.sample()
                for ids in value[0]:
                    ours.send({key: part[list(ids)] for key, part in action.items()}, ids)
                rows: dict[int, Row] = {}
                while ours.outstanding:
                    rows |= received(ours, min(value[1], len(ours.outstanding)))
                wanted = theirs.step(action)
                ended = wanted[2] | wanted[3]
                each = of_copies(theirs, wanted[0])
                for n, row in rows.items():
                    of_copy = Row(each[n], wanted[1][n], wanted[2][n], wanted[3][n], info_of(wanted[4], n))
                    assert bit_equal(tuple(row), tuple(of_copy)), f"copy {n}: {row} is not {of_copy}"
                assert sorted(rows) == [0, 1, 2]
            case "reset":
                same("reset", seed=value[0], options=value[1])
                ended[:] = False
            case "reset_async":
                ours.reset_async(value[0], value[1])
                assert bit_equal(ours.reset_wait(), theirs.reset(seed=value[0], options=value[1]))
                ended[:] = False
            case "mask":
                seed_argument, other_options, mask = value
                same("reset", seed=seed_argument, options={"reset_mask": np.array(mask), **(other_options or {})})
                ended &= ~np.array(mask)
            case "call":
                same("call", "shout", value[0], times=value[1])
            case "set_attr":
                same("set_attr", "level", value)
            case "get_attr":
                same("get_attr", value)
            case "render":
                same("render")


def test_with_more_lanes_than_workers_all_lanes_are_placed_at_once() -> None:
    """Only a lane whose worker died waits for the restarted worker."""
    env = millrace.make_vec("CartPole-v1", 4, workers=1, lanes=4, timeout=5)
    env.reset(seed=1)  # within the deadline, which is shorter than that wait
    assert env.step(np.zeros(4, np.int64))[1].tolist() == [1.0] * 4
    assert len(env.hub.coordinator.members) == 1
    env.close()


def test_by_default_there_is_a_worker_for_each_core_that_this_process_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("millrace.learner.vector_env.settings.usable_cores", lambda: 3)
    assert VectorEnvSettings("CartPole-v1", 8).local_workers == 3
    assert VectorEnvSettings("CartPole-v1", 2).local_workers == 2


@pytest.mark.parametrize("name", ["workers", "max_env_failures"])
def test_a_negative_number_is_refused_in_one_line(name: str) -> None:
    with pytest.raises(UsageError, match=rf"^{name}: expected at least 0, got -1$"):
        millrace.make_vec("CartPole-v1", 2, **{name: -1})  # type: ignore[arg-type]
