"""Environments with several agents: PettingZoo's parallel and AEC interfaces, as one environment with A seats.

A seat is an agent's place in an env copy, in the order of `possible_agents`. Its agent may act at every step or only when it
has the move, leave before the others, or join later.

Rule: a row of a seat spans the time from one of the seat's actions to its next observation: the one in which it has the move
again, or its last one. `SeatStep.complete` marks the step that returns this observation. Until then, the seat waits, and its
entry repeats the observation in which it acted. Rewards belong to the row in which they occur; rewards outside of any row
count only in the return. An agent whose part of the episode has ended is out until the reset, even if `agents` lists it.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Iterable, Mapping, Sequence
from copy import deepcopy
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from millrace.protocol.bounds import MAX_NAME, one_line
from millrace.protocol.envs.answers import OF_STEP, WrongAnswer, in_words, reset_answer, wrong_step
from millrace.protocol.envs.found_names import attribute
from millrace.protocol.errors import UsageError, safe_repr

SEAT = "seat"
STATE = "state"
"""Keys of observations: `seat` is the seat's number (with `--seat-id`), `state` is the environment's `state()` (with
`--critic-keys state`).
"""
MAX_AGENT_NAME = MAX_NAME - len("return_")  # characters; leaves room for the prefix in the name of the agent's return
_NO_INFO: Mapping[str, Any] = {}
RETURNED_WRONGLY = AttributeError, KeyError, TypeError, ValueError, OverflowError
"""Exceptions that reading an environment's results raises if a dict lacks an agent, or values aren't dicts or numbers."""


class SeatStep(NamedTuple):
    """The result of one step of a copy, for each of its A seats. The lists are new at each step."""

    observations: list[Any]
    """the latest observation of each seat; before its first one, an arbitrary value of the space"""
    infos: list[Mapping[str, Any]]
    """infos of the seats that got an observation in this step; empty for the others"""
    reward: list[float]
    """for complete rows, the sum of the rewards since the seat acted; 0 for other seats"""
    terminated: list[bool]
    truncated: list[bool]
    """for complete rows, whether the seat's part of the episode ends with the row"""
    complete: list[bool]
    """whether this step completes a row of the seat"""
    acts: list[bool]
    """whether the seat acts in the next step"""
    outside: list[float]
    """rewards outside of any row: before the seat's first action, or after its end"""


def side_by_side(copies: Iterable[SeatStep]) -> SeatStep:
    """Concatenate the `SeatStep` of several copies into one for all their seats."""
    return SeatStep(*([seat for of_copy in of_copies for seat in of_copy] for of_copies in zip(*copies, strict=True)))


def columns_of(copies: Sequence[int], seats: int) -> Sequence[int]:
    """The columns of these env copies in the rows of their lane. Each copy has `seats` adjacent columns."""
    return copies if seats == 1 else [n * seats + seat for n in copies for seat in range(seats)]


class SeatedEnv(gymnasium.Env[SeatStep, Sequence[Any]]):
    """One env copy with A seats. `reset` and `step` return a `SeatStep` in place of the observation.

    `step` takes an action for each seat, and ignores those of seats that don't act. The reward that it returns is 0, and
    `terminated` is True when no agent is left.
    """

    takes_turns: ClassVar[bool]
    """Whether a seat may have to wait for others between two of its actions."""

    def __init__(self, env: Any, name: str) -> None:
        """Wrap a PettingZoo environment. `name` is its name in errors.

        Raises `UsageError` unless all agents have the same spaces.
        """
        self.env = env
        self.metadata = getattr(env, "metadata", {})
        self.render_mode = getattr(env, "render_mode", None)
        self.agents = list(env.possible_agents)
        self.seats = _names(self.agents)
        self.seat_of = {agent: number for number, agent in enumerate(self.agents)}
        self._gone = set[Any]()  # agents whose part of the episode has ended
        self._tells_seats, shows_state = (getattr(env, name, False) for name in ("tells_seats", "shows_state"))
        observation, self.action_space = (
            _common([kind(agent) for agent in self.agents], self.seats, what, name, padded)
            for kind, what, padded in (
                (env.observation_space, "observation", "pad_observations_v0"),
                (env.action_space, "action", "pad_action_space_v0"),
            )
        )
        own = set(observation.spaces) if isinstance(observation, spaces.Dict) else set[str]()
        # If the observation has a part of this name, `critic_keys` means that part.
        self._state_space = _state_space(env, name) if shows_state and STATE not in own else None
        if self._tells_seats and SEAT in own:
            raise UsageError(
                f"environment {name}: seat_id: its observations have a part {SEAT!r} of their own; leave it out"
            )
        more: dict[str, gymnasium.Space[Any]] = {SEAT: spaces.Discrete(len(self.seats))} if self._tells_seats else {}
        if self._state_space is not None:
            more[STATE] = self._state_space
        seen: gymnasium.Space[Any] = spaces.Dict({**_parts(observation), **more}) if more else observation
        self.observation_space = seen
        self._before = [
            self._seen(seat, _any_value(observation), state=_any_value(self._state_space)) for seat in range(len(self.seats))
        ]

    def _seen(self, seat: int, observation: Any, state: Any = None) -> Any:
        """A seat's observation, with the seat's number if the wrapper `seat_id` is used, and with the environment's state if
        `with_state` is used.
        """
        if not self._tells_seats and self._state_space is None:
            return observation
        named = dict(observation) if isinstance(observation, dict) else {"observation": observation}
        if self._tells_seats:
            named[SEAT] = np.int64(seat)
        if self._state_space is not None:
            named[STATE] = np.array(self.env.state() if state is None else state)
        return named

    def _state_before(self, seen: Any, terminated: bool) -> Any:
        """The environment's state in a seat's last observation if the seat is terminated; None if the environment has to be
        asked for it.

        Nothing is learned from the state after the end, and some environments have none, because they have removed the
        agent's parts.
        """
        return seen[STATE] if terminated and self._state_space is not None else None

    def _nothing(self) -> SeatStep:
        """A `SeatStep` in which nothing has happened yet, to be filled."""
        A = len(self.seats)
        return SeatStep(
            list(self._before), [_NO_INFO] * A, [0.0] * A, [False] * A, [False] * A, [False] * A, [False] * A, [0.0] * A
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[SeatStep, dict[str, Any]]:
        """Begin an episode. Raises `WrongAnswer` if no agent acts after the reset."""
        step = self._nothing()
        self._gone.clear()
        self._begin(step, {"seed": seed} if options is None else {"seed": seed, "options": options})
        if True not in step.acts:
            raise WrongAnswer("its reset: expected an agent that acts after it, got none")
        self._check_agents()
        self._last = list(step.observations)
        return step, {}

    def step(self, action: Sequence[Any]) -> tuple[SeatStep, float, bool, bool, dict[str, Any]]:
        """Step the copy with an action for each seat."""
        step = self._nothing()._replace(observations=self._last)
        over = self._advance(action, step)
        self._last = list(step.observations)
        return step, 0.0, over, False, {}

    def _check_agents(self, rewards: Iterable[Any] = ()) -> None:
        for what, agents in (("agents", self.env.agents), ("rewards", rewards)):
            if unknown := [agent for agent in agents if agent not in self.seat_of]:
                raise WrongAnswer(f"{what}: expected some of possible_agents, got {unknown[0]}")

    def pending(self) -> list[float]:
        """[A] rewards that seats have earned while waiting for the move, and that no step has returned yet."""
        return [0.0] * len(self.seats)

    @abstractmethod
    def _begin(self, step: SeatStep, keywords: Mapping[str, Any]) -> None:
        """Reset the environment, and write the result into `step`."""

    @abstractmethod
    def _advance(self, actions: Sequence[Any], step: SeatStep) -> bool:
        """Step the environment, and write the result into `step`. Returns whether the episode is over."""

    def owner(self, name: str) -> Any:
        """The outermost PettingZoo wrapper that itself has this attribute; the environment if no wrapper has it.

        The search ends at a gymnasium environment, because its own methods search the wrappers inside it.
        """
        owner = self.env
        while name not in dir(owner) and not isinstance(owner, gymnasium.Env):
            inner = getattr(owner, "env", None) or getattr(owner, "aec_env", None)  # the latter after `parallel_wrapper_fn`
            if inner is None:
                break
            owner = inner
        return owner

    def has_wrapper_attr(self, name: str) -> bool:
        """Whether PettingZoo's environment, one of its wrappers or this object has the attribute."""
        return _has(self.owner(name), name) or hasattr(self, name)

    def get_wrapper_attr(self, name: str) -> Any:
        """The attribute of PettingZoo's environment or of one of its wrappers; if they lack it, of this object."""
        owner = self.owner(name)
        if not _has(owner, name):
            return getattr(self, name)
        return owner.get_wrapper_attr(name) if isinstance(owner, gymnasium.Env) else getattr(owner, name)

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        """Set the attribute of PettingZoo's environment or of one of its wrappers; without `force`, only if it exists.

        Returns whether it was set.
        """
        owner = self.owner(name)
        if isinstance(owner, gymnasium.Env):
            return owner.set_wrapper_attr(name, value, force=force)
        if there := force or hasattr(owner, name):
            setattr(owner, name, value)
        return there

    def render(self) -> Any:
        """The environment's rendered frame."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


class ParallelSeats(SeatedEnv):
    """All agents that are present act at every step (`pettingzoo.ParallelEnv`)."""

    takes_turns = False

    def _begin(self, step: SeatStep, keywords: Mapping[str, Any]) -> None:
        observations, infos = reset_answer(self.env.reset(**keywords))
        self._present = [agent for agent in self.agents if agent in self.env.agents]
        try:
            for agent in self._present:
                self._shows(step, agent, observations[agent], infos.get(agent))
        except RETURNED_WRONGLY as error:
            self._explain(error, self._present, observations=observations)
            raise

    def _advance(self, actions: Sequence[Any], step: SeatStep) -> bool:
        given = {agent: actions[self.seat_of[agent]] for agent in self._present}
        answer = self.env.step(given)
        try:
            observations, rewards, terminated, truncated, infos = answer
        except (TypeError, ValueError) as error:
            raise wrong_step(answer) from error
        infos = _NO_INFO if infos is None else infos
        try:
            return self._takes(given, step, observations, rewards, terminated, truncated, infos)
        except RETURNED_WRONGLY as error:
            self._explain(
                error, given, rewards=rewards, terminated=terminated, truncated=truncated, observations=observations
            )
            self._explain(error, (), infos=infos)
            self._check_agents(rewards)
            for agent in rewards:
                flags = {"terminated": terminated[agent], "truncated": truncated[agent]} if agent in given else {}
                _check_numbers(agent, reward=rewards[agent], **flags)
            raise

    def _takes(self, given: Mapping[Any, Any], step: SeatStep, *returned: Mapping[Any, Any]) -> bool:
        observations, rewards, terminated, truncated, infos = returned
        seen, told, reward, terminates, truncates, complete, acts, outside = step
        here = set(self.env.agents)
        for agent in given:
            seat = self.seat_of[agent]
            info = infos.get(agent, _NO_INFO)
            complete[seat] = True
            reward[seat] = _number(rewards[agent])
            told[seat] = info if type(info) is dict else _info(agent, info)
            terminates[seat] = bool(terminated[agent])
            truncates[seat] = bool(truncated[agent])
            # If the agent is terminated, its last observation may be missing, because nothing is learned from it.
            if not terminates[seat] or observations.get(agent) is not None:
                seen[seat] = self._seen(seat, observations[agent], state=self._state_before(seen[seat], terminates[seat]))
            if terminates[seat] or truncates[seat]:
                self._gone.add(agent)
            elif agent in here:
                acts[seat] = True
            else:
                raise WrongAnswer(f"agent {agent} left, expected it to be terminated or truncated in its last step")
        for agent in rewards.keys() - given.keys():
            outside[self.seat_of[agent]] = _number(rewards[agent])
        here -= self._gone
        for agent in here - given.keys():
            self._shows(step, agent, observations[agent], infos.get(agent))
        self._present = [agent for agent in self.agents if agent in here]
        return not self._present

    def _explain(self, error: Exception, agents: Collection[Any], **returned: Any) -> None:
        """Raise a `WrongAnswer` if something that the environment returned caused the error."""
        self._check_agents()
        for what, by_agent in returned.items():
            if not isinstance(by_agent, Mapping):
                raise WrongAnswer(f"{what}: expected a dict by agent, got {type(by_agent).__name__}") from error
            if missing := [agent for agent in agents if agent not in by_agent]:
                got = ", ".join(map(str, by_agent)) or "none"
                raise WrongAnswer(f"{what}: expected agent {missing[0]} among them, got {got}") from error

    def _shows(self, step: SeatStep, agent: Any, observation: Any, info: Any) -> None:
        seat = self.seat_of[agent]
        step.observations[seat] = self._seen(seat, observation)
        step.acts[seat] = True
        step.infos[seat] = _info(agent, info)


class TurnSeats(SeatedEnv):
    """One agent acts at a time (`pettingzoo.AECEnv`). A step is one agent's action. After it, every agent whose part of the
    episode is over leaves.
    """

    takes_turns = True

    def _begin(self, step: SeatStep, keywords: Mapping[str, Any]) -> None:
        self.env.reset(**keywords)
        self._waits = [False] * len(self.seats)
        self._next(step)

    def _advance(self, actions: Sequence[Any], step: SeatStep) -> bool:
        seat = self.seat_of[self.env.agent_selection]
        self._waits[seat] = True
        self.env.step(actions[seat])
        return self._next(step)

    def _next(self, step: SeatStep) -> bool:
        """Let agents whose part has ended leave, and find who has the move. Returns whether nobody is left."""
        while (left := self.env.agents) and not (self._gone and self._gone.issuperset(left)):
            agent = self.env.agent_selection
            if agent in self._gone or agent not in self.seat_of:
                raise self._wrong_selection(agent)
            seat = self.seat_of[agent]
            answer = self.env.last()
            try:
                observation, reward, terminated, truncated, info = answer
            except (TypeError, ValueError) as error:
                raise WrongAnswer(f"its last() returned {in_words(answer)}; {OF_STEP}") from error
            try:
                if self._waits[seat]:
                    step.complete[seat] = True
                    step.reward[seat] = _number(reward)
                    step.terminated[seat] = bool(terminated)
                    step.truncated[seat] = bool(truncated)
                else:
                    step.outside[seat] = _number(reward)
            except RETURNED_WRONGLY:
                _check_numbers(agent, reward=reward, terminated=terminated, truncated=truncated)
                raise
            if observation is not None:  # copied, because it is kept until the seat has the move again
                state = self._state_before(step.observations[seat], terminated)
                step.observations[seat] = self._seen(seat, deepcopy(observation), state=state)
            elif not terminated and (self._waits[seat] or not truncated):  # needed to act, or to bootstrap
                raise WrongAnswer(f"agent {agent}: expected an observation unless it is terminated, got None")
            self._waits[seat] = False
            step.infos[seat] = info if type(info) is dict else _info(agent, info)
            if not (terminated or truncated):
                step.acts[seat] = True
                return False
            self._gone.add(agent)
            self.env.step(None)
        if True in self._waits:
            who = self.seats[self._waits.index(True)]
            raise WrongAnswer(f"agent {who} left, expected it to be selected once more when its part had ended")
        return True

    def _wrong_selection(self, agent: Any) -> WrongAnswer:
        if agent not in self.seat_of:
            return WrongAnswer(f"agent_selection: expected one of possible_agents, got {agent}")
        return WrongAnswer(
            f"agent_selection: expected an agent whose part has not ended, got {agent} again; after its end, step(None) "
            "selects another one"
        )

    def pending(self) -> list[float]:
        """[A] rewards that agents without the move have earned since their last move, as PettingZoo's base class sums them.

        They are 0 if the environment doesn't use that sum. Raises `WrongAnswer` for a sum that isn't a number.
        """
        earned = getattr(self.env, "_cumulative_rewards", {})
        waits = set(self.env.agents) - self._gone - {self.env.agent_selection}
        of_waiting = {agent: earned[agent] for agent in waits if agent in earned}
        try:
            return [_number(of_waiting.get(agent, 0.0)) for agent in self.agents]
        except RETURNED_WRONGLY:
            for agent, reward in of_waiting.items():
                _check_numbers(agent, reward=reward)
            raise


def _info(agent: Any, info: Any) -> Mapping[str, Any]:
    """The info of an agent; empty if there is none. Raises `WrongAnswer` if it isn't a dict."""
    if info is not None and not isinstance(info, Mapping):
        raise WrongAnswer(f"info of agent {agent}: expected a dict, got {type(info).__name__}")
    return info or _NO_INFO


def _check_numbers(agent: Any, **numbers: Any) -> None:
    """Raise `WrongAnswer` for a value that isn't a number."""
    for what, value in numbers.items():
        try:
            _number(value) if what == "reward" else bool(value)
        except RETURNED_WRONGLY as error:
            raise WrongAnswer(f"{what} of agent {agent}: expected a number, got {one_line(safe_repr(value), 80)}") from error


def _has(owner: Any, name: str) -> bool:
    """Whether the owner of an attribute (see `SeatedEnv.owner`) has it."""
    return owner.has_wrapper_attr(name) if isinstance(owner, gymnasium.Env) else hasattr(owner, name)


def has_seats(made: object) -> bool:
    """Whether an object is an environment of several agents in one of PettingZoo's interfaces."""
    is_method = callable(attribute(made, "observation_space")) and callable(attribute(made, "action_space"))
    return is_method and attribute(made, "possible_agents") is not None


def seat_id(env: Any) -> Any:
    """A wrapper for a PettingZoo environment that adds to each observation the number of its seat, under the key `seat`.

    It must be the outermost wrapper. Raises `UsageError` for an environment without seats.
    """
    if not has_seats(env):
        name = env.spec.id if getattr(env, "spec", None) is not None else type(env).__name__
        raise UsageError(f"seat_id: expected an environment of several agents, got {name}; omit seat_id")
    env.tells_seats = True
    return env


def with_state(env: Any) -> Any:
    """A wrapper for a PettingZoo environment that adds its `state()` to each observation, under the key `state`.

    It must be applied after all PettingZoo wrappers. A gymnasium environment is returned unchanged.
    """
    if has_seats(env):
        env.shows_state = True
    return env


def _number(value: Any) -> float:
    """A reward as a number. As in gymnasium, an array with one element counts as a number."""
    return float(value.item() if isinstance(value, np.ndarray) else value)


def _state_space(env: Any, name: str) -> gymnasium.Space[Any]:
    """The space of `env.state()`.

    Raises `UsageError` if the environment doesn't define it and it can't be derived from a state.
    """
    try:
        space: gymnasium.Space[Any] | None = getattr(env, "state_space", None)
        if space is not None:
            return space
        env.reset()
        if not callable(env.state):
            raise AttributeError("state")
        state = np.asarray(env.state())
    except (NotImplementedError, AttributeError) as error:
        raise UsageError(f"environment {name}: critic_keys state: expected a method state(), got none") from error
    if state.dtype.kind not in "fi":  # bytes, for example, may be brightnesses, flags or counts
        raise UsageError(
            f"environment {name}: critic_keys state: expected state() to return an array of floats or signed integers, got "
            f"{state.dtype}; give the environment a state_space, which says what they mean"
        )
    return spaces.Box(-np.inf, np.inf, state.shape, state.dtype.type)


def seated(made: Any, name: str) -> SeatedEnv:
    """A PettingZoo environment as an environment with seats.

    Raises `UsageError` if it has no agents, if two of them have the same name, or if their spaces differ.
    """
    if not made.possible_agents:
        raise UsageError(
            f"environment {name}: expected at least one agent in its possible_agents, got none; it must list all agents "
            "before its first reset"
        )
    named: dict[str, Any] = {}
    for agent, text in zip(made.possible_agents, _names(made.possible_agents), strict=True):
        if text in named:
            both = " and ".join(one_line(repr(each), 60) for each in (named[text], agent))
            raise UsageError(
                f"environment {name}: possible_agents: expected agents of different names, got {both}; names are text, and "
                f"their first {MAX_AGENT_NAME - 1} characters count"
            )
        named[text] = agent
    kind = TurnSeats if hasattr(made, "agent_iter") else ParallelSeats
    return kind(made, name)


def _names(agents: Iterable[Any]) -> tuple[str, ...]:
    """The names of the agents, as the learner, metrics and errors show them."""
    return tuple(one_line(str(agent), MAX_AGENT_NAME) for agent in agents)


def _common(
    spaces: Sequence[gymnasium.Space[Any]], seats: Sequence[str], what: str, name: str, padded: str
) -> gymnasium.Space[Any]:
    """The space that all agents have. Raises `UsageError` if there is none."""
    for space, seat in zip(spaces, seats, strict=True):
        if space != spaces[0]:
            raise UsageError(
                f"environment {name}: expected one {what} space for all agents, got {spaces[0]} for {seats[0]} and {space} "
                f"for {seat}; if they differ in size, --wrappers supersuit:{padded} pads them"
            )
    return spaces[0]


def _parts(space: gymnasium.Space[Any]) -> dict[str, gymnasium.Space[Any]]:
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {"observation": space}


def _any_value(space: gymnasium.Space[Any] | None) -> Any:
    """An arbitrary value of the space; the same one at every call. None if there is no space."""
    match space:
        case None:
            return None
        case spaces.Dict():
            return {key: _any_value(inner) for key, inner in space.spaces.items()}
        case spaces.Tuple():
            return tuple(map(_any_value, space.spaces))
        case spaces.Box():
            return np.clip(np.zeros(space.shape, space.dtype), space.low, space.high).astype(space.dtype)
        case spaces.Discrete():
            return space.dtype.type(space.start)
        case spaces.MultiDiscrete():
            return space.start.copy()
        case _:
            return np.zeros(space.shape or (), space.dtype)
