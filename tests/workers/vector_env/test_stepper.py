"""The stepper of a worker: which attributes of its env copies a learner may use, and which results it refuses."""

from __future__ import annotations

import sys
from collections import defaultdict, deque
from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any, ClassVar, Literal, cast

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

import millrace
from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.protocol.errors import EnvironmentFailed
from millrace.protocol.messages import Call, Reset, Returned, Step, Stepped
from millrace.protocol.wire.plain_values import ReprString, pack, unpack
from millrace.workers.copies.env_loop import EnvLoop
from millrace.workers.vector_env.stepper import Stepper
from tests.support.conversation.example_messages import example
from tests.support.envs.toy import Countdown
from tests.support.in_process.described import step_spec
from tests.support.numbers.bit_equality import bit_equal


def call(stepper: Stepper, name: str, arguments: Any, *, assign: bool = False) -> Returned:
    packed = np.frombuffer(pack(arguments), np.uint8)
    answer = stepper.execute(
        example(Call, session=1, ticket=1, copies=(0, 1), name=name, assign=assign, given=packed), lambda: None
    )
    assert isinstance(answer, Returned)
    return answer


@pytest.mark.parametrize("name", ["_k", "__class__", "_max_episode_steps"])
@pytest.mark.parametrize("assign", [False, True])
def test_private_attributes_are_not_given_to_a_learner_that_is_not_trusted(name: str, assign: bool) -> None:
    step = step_spec(VectorEnvSettings("tests.support.envs.toy:Countdown-v0", 2, lanes=1, kwargs={"k": 3}))
    stepper = Stepper(step, allow_private_names=False)
    answer = call(stepper, name, [4, 4] if assign else ((), {}), assign=assign)
    assert answer.error.startswith(
        f"UsageError: {name!r} begins with an underscore: this worker gives private attributes only to"
    )
    assert "\n" not in answer.error
    stepper.lanes.close_all()


@pytest.mark.parametrize(
    ("method", "arguments"),
    [
        ("get_wrapper_attr", (("_k",), {})),
        ("has_wrapper_attr", (("_k",), {})),
        ("set_wrapper_attr", (("_k", 9), {})),
        ("set_wrapper_attr", ((), {"name": "_k", "value": 9})),
    ],
)
def test_nor_by_a_method_that_takes_their_name(method: str, arguments: Any) -> None:
    step = step_spec(VectorEnvSettings("tests.support.envs.toy:Countdown-v0", 2, lanes=1, kwargs={"k": 3}))
    stepper = Stepper(step, allow_private_names=False)
    assert call(stepper, method, arguments).error.startswith("UsageError: '_k' begins with an underscore")
    stepper.lanes.close_all()


def test_private_attributes_are_given_to_a_learner_that_may_run_code() -> None:
    stepper = Stepper(step_spec(VectorEnvSettings("tests.support.envs.toy:Countdown-v0", 2, lanes=1, kwargs={"k": 3})))
    assert call(stepper, "_k", [4, 5], assign=True).error == ""
    answer = call(stepper, "_k", ((), {}))
    assert (answer.error, unpack(answer.results.data)) == ("", [4, 5])
    stepper.lanes.close_all()


# ------------------------------------------------------------------------------------------------ what copies return


class Changes(Countdown):
    """Its observation is `later` from the fourth step on, and its reward is `reward`."""

    def __init__(self, nested: bool = False, reward: Any = 1.0, later: str = "np.zeros(3)") -> None:
        super().__init__(50)
        box = gymnasium.spaces.Box(-9, 9, (2,), np.float32)
        self.observation_space = gymnasium.spaces.Dict({"a": box}) if nested else box  # type: ignore[assignment]
        self._nested, self._later, self._reward = nested, later, reward

    def _observation(self) -> Any:
        value = np.zeros(2, np.float32) if self._left > 46 else eval(self._later)
        return {"a": value} if self._nested else value


def stepped(env: Callable[[], Any], steps: int) -> list[Stepped]:
    """The answers of two copies in a vector environment to `steps` steps."""
    stepper = Stepper(step_spec(VectorEnvSettings(env, 2, lanes=1)))
    answers = [
        stepper.execute(
            example(Reset, session=1, ticket=1, copies=(0, 1), seeds=(0, 1), options=np.frombuffer(pack(None), np.uint8)),
            lambda: None,
        )
    ]
    actions = (np.zeros(2, np.int64),)
    answers += [
        stepper.execute(example(Step, session=1, ticket=t, actions=actions), lambda: None) for t in range(2, 2 + steps)
    ]
    return [answer for answer in answers if isinstance(answer, Stepped)]


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize(
    ("later", "got"),
    [
        ("np.zeros(1, np.float32)", "float32[1]"),
        ("np.zeros((1, 2), np.float32)", "float32[1, 2]"),
        ("np.float32(0)", "float32[]"),
        ("None", "object[]"),
        ("'1'", "<U1[]"),
        ("['1', '2']", "<U1[2]"),
    ],
)
def test_an_observation_that_does_not_fit_is_refused_at_every_step(nested: bool, later: str, got: str) -> None:
    named = "observation a" if nested else "observation"
    assert len(stepped(partial(Changes, nested), 3)) == 4
    with pytest.raises(EnvironmentFailed) as caught:
        stepped(partial(Changes, nested, later=later), 4)
    expected = f"{named}: expected float32[2] as its space says, got {got}; fix the environment or its observation_space"
    assert str(caught.value) == f"lane 0, copy 0, step 3: {expected}"


class Encloses(Countdown):
    """The info of each step contains itself."""

    def __init__(self, kind: type) -> None:
        super().__init__(50)
        self._kind = kind

    def step(self, action: Any) -> Any:
        info: dict[str, Any] = {"a": 1}
        info["inner"] = info if self._kind is dict else self._kind([0])
        if self._kind is not dict:
            info["inner"].append(info["inner"])
        return *super().step(action)[:4], info


@pytest.mark.parametrize("kind", [list, deque, dict])
def test_what_contains_itself_arrives_as_a_line_inside_its_info(kind: type) -> None:
    for _, info in unpack(stepped(partial(Encloses, kind), 1)[-1].infos.data):
        assert (info, type(info["inner"])) == ({"a": 1, "inner": f"<{kind.__name__} that contains itself>"}, ReprString)


class OddInfo(dict[Any, Any]):
    """A dict that can't be read."""

    def items(self) -> Any:
        raise ValueError("no items")


class InfoInList(Countdown):
    """The info of each step contains a dict that can't be read."""

    def step(self, action: Any) -> Any:
        return *super().step(action)[:4], {"a": [OddInfo(b=1)]}


def test_an_info_that_raises_when_it_is_packed_is_an_error_of_the_environment() -> None:
    with pytest.raises(EnvironmentFailed, match=r"^lane 0, infos: its environment raised ValueError: no items$"):
        stepped(partial(InfoInList, 50), 1)


class Blind(Countdown):
    """Its observations have no arrays."""

    def __init__(self) -> None:
        super().__init__(50)
        self.observation_space = gymnasium.spaces.Dict({})  # type: ignore[assignment]

    def _observation(self) -> Any:
        return {}


def test_an_observation_may_have_no_arrays() -> None:
    answers = stepped(Blind, 2)
    assert [(answer.obs, answer.reward.tolist()) for answer in answers] == [
        ((), [0.0, 0.0]),
        ((), [1.0, 1.0]),
        ((), [1.0, 1.0]),
    ]


class Halves(Countdown):
    """Halves its action in place; the reward is the first number of it."""

    def __init__(self) -> None:
        super().__init__(50)
        self.action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def step(self, action: Any) -> Any:
        action *= 0.5
        observation, _, *rest = super().step(action)
        return observation, float(action[0]), *rest


def test_an_environment_may_change_its_action() -> None:
    stepper = Stepper(step_spec(VectorEnvSettings(Halves, 2, lanes=1)))
    stepper.execute(
        example(Reset, session=1, ticket=1, copies=(0, 1), seeds=(0, 1), options=np.frombuffer(pack(None), np.uint8)),
        lambda: None,
    )
    actions = np.ones((2, 2), np.float32)
    actions.flags.writeable = False  # as that of a message
    for t in (2, 3):
        answer = stepper.execute(example(Step, session=1, ticket=t, actions=(actions,)), lambda: None)
        assert isinstance(answer, Stepped)
        assert answer.reward.tolist() == [0.5, 0.5]
    stepper.lanes.close_all()


class Buffered(Countdown):
    """Returns its observation in the same array again and again."""

    def __init__(self) -> None:
        super().__init__(2)
        self._buffer = np.zeros(1, np.float32)

    def _observation(self) -> Any:
        self._buffer[:] = self._left
        return self._buffer


def test_the_last_observation_of_an_episode_is_not_that_of_the_reset() -> None:
    loop, observations = EnvLoop([Buffered], lambda: None, "SameStep"), [np.zeros(1)]
    loop.reset([0], [1], observations, lambda: None)
    loop.step([0], observations, lambda: None)
    ((copy, info),) = loop.step([0], observations, lambda: None)
    assert (copy, info["final_obs"].tolist(), observations[0].tolist()) == (0, [0.0], [2.0])
    loop.close()


class SharesInfo(Countdown):
    """All copies return the same dict as their info."""

    info: ClassVar[dict[str, Any]] = {"deep": {}}
    made = 0

    def __init__(self) -> None:
        super().__init__(50)
        SharesInfo.made += 1
        self._number = SharesInfo.made

    def _observation(self) -> Any:
        self.info["number"] = self.info["deep"]["number"] = self._number
        return super()._observation()

    def reset(self, **keywords: Any) -> Any:
        return super().reset(**keywords)[0], self.info

    def step(self, action: Any) -> Any:
        return *super().step(action)[:4], self.info


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_copies_may_return_one_dict_as_their_info(mode: Literal["NextStep", "SameStep", "Disabled"]) -> None:
    loop, observations = EnvLoop([SharesInfo] * 3, lambda: None, mode), [None] * 3
    first = SharesInfo.made - 2
    expected = [(n, {"number": first + n, "deep": {"number": first + n}}) for n in range(3)]
    assert loop.reset(range(3), [1, 2, 3], observations, lambda: None) == expected
    assert loop.step([0, 0, 0], observations, lambda: None) == expected
    loop.close()


class RepeatsDict(Countdown):
    """Its info contains a dict twice, which contains another dict twice, and so on."""

    def step(self, action: Any) -> Any:
        info: dict[str, Any] = {}
        for _ in range(8):
            info = {"a": info, "b": info}
        return *super().step(action)[:4], info


def test_a_dict_that_occurs_in_several_places_of_an_info_is_copied_once() -> None:
    """Otherwise, one that occurs in 2^32 places would take that many copies."""
    loop, observations = EnvLoop([partial(RepeatsDict, 50)], lambda: None, "Disabled"), [None]
    loop.reset([0], [1], observations, lambda: None)
    ((_, info),) = loop.step([0], observations, lambda: None)
    while info:
        assert info["a"] is info["b"]
        info = info["a"]
    loop.close()


class OnlyWhileOpen(Countdown):
    """Raises in a step after `close`."""

    open = True

    def step(self, action: Any) -> Any:
        assert self.open, "stepped after close"
        return super().step(action)

    def close(self) -> None:
        self.open = False


def test_a_lane_that_is_released_during_a_step_is_closed_after_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("millrace.workers.copies.env_loop.PULSE_S", -1.0)  # a pulse after each copy
    stepper, envs = Stepper(step_spec(VectorEnvSettings(OnlyWhileOpen, 2, lanes=1))), list[OnlyWhileOpen]()
    stepper.execute(
        example(Reset, session=1, ticket=1, copies=(0, 1), seeds=(0, 1), options=np.frombuffer(pack(None), np.uint8)),
        lambda: None,
    )
    envs += [cast(OnlyWhileOpen, env.unwrapped) for env in stepper.lanes[0]._loop.envs]
    answer = stepper.execute(
        example(Step, session=1, ticket=2, actions=(np.zeros(2, np.int64),)), lambda: stepper.lanes.close([0])
    )
    assert isinstance(answer, Stepped)
    assert answer.reward.tolist() == [1.0, 1.0]
    assert [env.open for env in envs] == [False, False]


def test_a_lane_that_is_released_while_its_copies_are_made_is_closed_after_the_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    closed: list[EnvLoop] = []
    monkeypatch.setattr(EnvLoop, "close", lambda loop: closed.append(loop))
    stepper = Stepper(step_spec(VectorEnvSettings(Countdown, 2, lanes=1)))
    reset = example(Reset, session=1, ticket=1, copies=(0, 1), seeds=(0, 1), options=np.frombuffer(pack(None), np.uint8))
    answer = stepper.execute(reset, lambda: stepper.lanes.close([0]) if not closed else None)
    assert isinstance(answer, Stepped)
    assert len(closed) == 1
    stepper.lanes.close_all()
    assert len(closed) == 1


class BufferedInfo(Countdown):
    """Returns the same info again and again, as a subclass of dict. Its array is always the same one, too."""

    def __init__(self) -> None:
        super().__init__(2)
        self._info: dict[str, Any] = defaultdict(lambda: np.zeros(1))

    def _observation(self) -> Any:
        self._info["left"][:] = self._left
        self._info["deep"] = {"left": self._left}
        return super()._observation()

    def reset(self, **keywords: Any) -> Any:
        return super().reset(**keywords)[0], self._info

    def step(self, action: Any) -> Any:
        return *super().step(action)[:4], self._info


def test_the_last_info_of_an_episode_is_not_that_of_the_reset() -> None:
    zeros = np.zeros(1, np.int64)
    theirs = SyncVectorEnv([BufferedInfo], autoreset_mode="SameStep")
    with millrace.make_vec(BufferedInfo, 1, transport="inproc", autoreset_mode="SameStep", timeout=20) as ours:
        assert bit_equal(ours.reset(seed=1), theirs.reset(seed=1))
        for _ in range(4):
            infos, wanted = ours.step(zeros)[4], theirs.step(zeros)[4]
            assert bit_equal(infos, wanted)
    assert infos["final_info"]["left"].tolist() == [[0.0]]
    assert infos["left"].tolist() == [[2.0]]


def test_rewards_are_numbers_or_arrays_of_one_element() -> None:
    assert stepped(partial(Changes, reward=np.array([2.5])), 1)[1].reward.tolist() == [2.5, 2.5]
    with pytest.raises(
        EnvironmentFailed, match=r"copy 0, step 0: reward: expected a number, got an array of shape \(2,\); wrap"
    ):
        stepped(partial(Changes, reward=np.zeros(2)), 1)


def test_the_line_about_a_reward_of_several_numbers_names_mo_gymnasium_s_wrapper(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mo_gymnasium", ModuleType("mo_gymnasium"))
    with pytest.raises(EnvironmentFailed, match=r"one number, as --wrappers mo_gymnasium.wrappers:LinearReward does$"):
        stepped(partial(Changes, reward=np.zeros(2)), 1)
