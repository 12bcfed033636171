"""The env copies of a lane, or of an evaluation, behind one interface: a loop over environments, or any vector environment.

Autoreset is gymnasium's NextStep: the step after an episode's end ignores the action and resets that copy. In an evaluation,
no step resets a copy. The result of a step is stored immediately, so copies may return the same buffers again and again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, Protocol

import gymnasium
from gymnasium.vector import VectorWrapper
from gymnasium.wrappers import OrderEnforcing

from millrace.protocol.arrays import Array, Bools, Doubles
from millrace.protocol.envs.action_masks import seen_space
from millrace.protocol.envs.description import agents_in_words, agents_of
from millrace.protocol.envs.spaces import action_spec, make_flatten, observation_leaves
from millrace.protocol.envs.which_copy import FIRST_COPY, EnvCopy
from millrace.protocol.errors import UsageError, first_line
from millrace.protocol.random_streams import Purpose, env_seed
from millrace.protocol.specs import RunSpec
from millrace.protocol.wire.plain_values import unpack
from millrace.workers.activity import EVALUATING, MAKING, REPEATING, STEPPING, activity
from millrace.workers.copies.env_errors import CopyFailed
from millrace.workers.copies.env_loop import Autoreset, CopyInfos, EnvLoop, Pulse
from millrace.workers.copies.episode_facts import Facts, facts_of_info
from millrace.workers.copies.mask_reader import MaskReader, unused_mask
from millrace.workers.copies.random_state import pack as pack_random_state
from millrace.workers.copies.row_writers import read_leaves
from millrace.workers.copies.saved_state import CannotSave, SavedCopy, load, save, saver

# For each leaf of the observation, an array [N, *leaf] or a sequence of N observations. In a masked run, masks come last.
Leaves = Sequence[Any]


class SeatColumns(NamedTuple):
    """The part of a step's result that exists only with seats, for N copies with A seats each."""

    complete: Bools
    """[N · A] whether a row of the seat is complete"""
    acts: Bools
    """[N · A] whether the seat acts in the next step"""
    outside: Doubles
    """[N · A] rewards that belong to no row"""
    over: Bools
    """[N] whether the copy's episode is over, so that its next step only resets it"""

    def first(self, copies: int, columns: int) -> SeatColumns:
        """The part that belongs to the first `copies` copies, which have the first `columns` columns."""
        return SeatColumns(
            complete=self.complete[:columns],
            acts=self.acts[:columns],
            outside=self.outside[:columns],
            over=self.over[:copies],
        )


class StepResult(NamedTuple):
    """The result of one step of N copies. `workers/copies/row_writers.py` writes each part of it into an array [N, …]."""

    leaves: Leaves
    reward: Any
    terminated: Any
    truncated: Any
    lost: Array | None = None
    """[N] bool, True for copies that were lost with their worker. They did not make this step, and the next step begins
    episodes on new copies in their place
    """
    facts: Facts = {}
    """facts of the episodes that ended in this step, if the run has facts"""
    columns: SeatColumns | None = None
    """None without seats; with seats, the arrays above have N · A entries"""

    def first(self, copies: int, columns: int) -> StepResult:
        """The part that belongs to the first `copies` copies, which have the first `columns` columns."""
        return self._replace(
            leaves=[leaf[:columns] for leaf in self.leaves],
            reward=self.reward[:columns],
            terminated=self.terminated[:columns],
            truncated=self.truncated[:columns],
            lost=None if self.lost is None else self.lost[:copies],
            columns=None if self.columns is None else self.columns.first(copies, columns),
        )


class EnvCopies(Protocol):
    """N env copies. Any exception from the environment is raised as `CopyFailed`; exceptions from `pulse` are raised
    unchanged.
    """

    observation_space: gymnasium.Space[Any]
    """Observation space of one copy."""
    action_space: gymnasium.Space[Any]
    """Action space of one copy."""
    note: str
    """What the user should know about the environment after its first reset; empty if there is nothing to report."""

    def reset(self, seeds: Sequence[int], pulse: Pulse) -> Leaves:
        """Begin episodes in all copies, with a seed for each."""
        ...

    def step(self, actions: Array, pulse: Pulse) -> StepResult:
        """Step with actions [N, *action] of the environment's dtype. A copy whose episode has ended is reset instead."""
        ...

    def assign(self, name: str, packed: bytes, pulse: Pulse) -> None:
        """Set an attribute of every copy to a value, packed by `millrace.protocol.wire.plain_values`."""
        ...

    def close(self) -> None:
        """Close the copies. Never raises."""
        ...


class EvaluationCopies(EnvCopies, Protocol):
    """Env copies of an evaluation: only copies with running episodes are stepped, and no step resets a copy."""

    count: int

    def step(self, actions: Array, pulse: Pulse, copies: Sequence[int] | None = None) -> StepResult:
        """Step these copies, with an action for each.

        The result has a row for every copy; a copy that isn't stepped keeps its last row.
        """
        ...

    def render(self, copy: int) -> Any:
        """The rendered frame of this copy. Raises `ValueError` if the copy can't be rendered."""
        ...


def check_spaces(run: RunSpec, copies: EnvCopies) -> None:  # rule OTHER_AGENTS
    """Raise `UsageError` unless the copies have the spaces and the agents of the run's policy."""
    observation = copies.observation_space
    action = copies.action_space
    policy = run.policy
    if (observation_leaves(observation), action_spec(action)) != (policy.seen, policy.action):
        raise UsageError(
            f"environment {run.env.id}: its observations {observation} and actions {action} are not those of the policy; "
            "install the version of the environment that the policy was made for"
        )
    seats, takes_turns = agents_of(copies.envs[0]) if isinstance(copies, LoopedCopies) else ((), False)
    if seats != run.seats or (takes_turns and not run.takes_turns):  # takes_turns means only that seats may wait
        raise UsageError(
            f"environment {run.env.id}: expected {agents_in_words(run.seats, run.takes_turns)}, got "
            f"{agents_in_words(seats, takes_turns)}; install the version of the environment that the run was started with"
        )


def copy_seed(seed: int, lane: int, start: int, copy: int) -> int:  # rule INDEPENDENT
    """The seed with which a copy of this lane is reset at its start number `start`."""
    return env_seed(seed, Purpose.COPIES, lane, start, copy)


class CopySettings(NamedTuple):
    """The settings of a run that apply to each of its copies in a loop."""

    facts: Sequence[str] = ()
    """names of numbers in `info` that describe an episode; the returns of seats aren't among them"""
    masked: bool = False
    """whether to read masks of the allowed actions"""
    critic_keys: Sequence[str] = ()
    """keys of a Dict observation whose arrays come last"""
    restart_episodes: int = 0
    """after this many episodes, a copy is closed and recreated; 0: never"""

    @classmethod
    def of(cls, run: RunSpec) -> CopySettings:
        """The settings of this run."""
        return cls(run.info_keys, run.masked, run.policy.critic_keys, run.restart_episodes)


PLAIN_COPIES = CopySettings()
"""No facts, masks or keys for the critic, and copies that are never recreated."""


class LoopedCopies:
    """N environments that are stepped one after another, in a loop."""

    def __init__(
        self,
        makes: Iterable[Callable[[], gymnasium.Env[Any, Any]]],
        pulse: Pulse,
        settings: CopySettings = PLAIN_COPIES,
        first: EnvCopy = FIRST_COPY,
    ) -> None:
        """Make the copies. `first` identifies the first copy. In an evaluation, no step resets a copy."""
        self._facts = settings.facts
        self._activity = activity()
        evaluates = first.evaluation
        autoreset: Autoreset = "Disabled" if evaluates else "NextStep"
        stepping = EVALUATING if evaluates else STEPPING
        self._attributes: dict[str, bytes] = {}  # attributes that were set on every copy, by name; the values are packed
        self._loop = EnvLoop(
            makes,
            pulse,
            autoreset,
            first=first,
            stepping=stepping,
            dress=self._dressed,
            restart_episodes=settings.restart_episodes,
        )
        self.envs = self._loop.envs
        self.count = len(self._loop.envs)
        with self._activity.during(MAKING):  # reading an attribute may run environment code
            self.observation_space = self.envs[0].observation_space
            self.action_space = self.envs[0].action_space
        self._masks = MaskReader(self.observation_space, self.action_space) if settings.masked else None
        self.note = ""
        self.saves = all(saver(env) is not None for env in self.envs)
        """whether the environment can save its state"""
        self.observation_space = seen_space(
            self.observation_space, self.action_space, masked=settings.masked, critic_keys=settings.critic_keys
        )
        self._nested = isinstance(self.observation_space, gymnasium.spaces.Dict | gymnasium.spaces.Tuple)
        self._read = make_flatten(self.observation_space)
        self._observations: list[Any] = [None] * self.count

    def reset(self, seeds: Sequence[int], pulse: Pulse) -> Leaves:
        """Begin episodes in all copies, or in the first ones, with a seed for each."""
        copies = range(len(seeds))
        infos = self._loop.reset(copies, seeds, self._observations, pulse)
        leaves = self._after_reset(copies, infos).leaves
        self.note = self._loop.never_anew()
        if self._masks is None:
            self.note = self.note or unused_mask((info for _, info in infos), self.action_space)
        return leaves

    def step(self, actions: Array, pulse: Pulse, copies: Sequence[int] | None = None) -> StepResult:
        """Step each copy, or reset it if its episode has ended.

        With `copies`, step only these, with an action for each. A copy that isn't stepped keeps its last row in the result.
        """
        copies = None if copies is not None and len(copies) == self.count else copies  # stepping all is faster
        loop = self._loop
        infos = loop.step(actions, self._observations, pulse, copies)
        leaves = self._leaves() if self._nested else (self._observations,)
        if self._masks is not None:
            leaves = (*leaves, self._read_masks(self._masks, infos, copies))
        if not self._facts:
            return StepResult(leaves, loop.reward, loop.terminated, loop.truncated)
        facts = {n: facts_of_info(self._facts, info, n) for n, info in infos if loop.terminated[n] or loop.truncated[n]}
        return StepResult(leaves, loop.reward, loop.terminated, loop.truncated, facts=facts)

    def reset_some(self, copies: Sequence[int], seeds: Sequence[int | None], pulse: Pulse) -> StepResult:
        """Begin episodes in these copies only, with a seed, or None, for each. The result has a row for every copy."""
        infos = self._loop.reset(copies, seeds, self._observations, pulse)
        self._fill_in(copies)
        return self._after_reset(copies, infos)

    def _dressed(self, env: gymnasium.Env[Any, Any], which: EnvCopy) -> gymnasium.Env[Any, Any]:
        """Prepare a new copy to be stepped. If it replaces an old copy, it gets the attributes that were set on that one."""
        env = without_order_check(env, which)
        for name, packed in self._attributes.items():
            set_attribute(which.copy, env, name, unpack(packed))
        return env

    def _fill_in(self, copies: Sequence[int]) -> None:
        """Fill the row of each copy that was never reset with the observation of another copy, because no row
        may be empty.
        """
        for n, observation in enumerate(self._observations):
            if observation is None:
                self._observations[n] = self._observations[copies[0]]

    def _after_reset(self, copies: Sequence[int], infos: CopyInfos) -> StepResult:
        leaves = self._leaves()
        if self._masks is not None:
            leaves = (*leaves, self._read_masks(self._masks, infos, copies))
        return StepResult(leaves, self._loop.reward, self._loop.terminated, self._loop.truncated)

    @contextmanager
    def repeating(self) -> Iterator[None]:
        """A context in which steps are recorded as replayed steps of an earlier episode."""
        stepping = self._loop.stepping
        self._loop.stepping = REPEATING
        try:
            yield
        finally:
            self._loop.stepping = stepping

    def end(self, copies: Sequence[int]) -> None:
        """End the episodes of these copies, so that the next step resets them."""
        for n in copies:
            self._loop.truncated[n] = True

    def set_random_state(self, copy: int, packed: bytes) -> bool:
        """Set the state of a copy's random generator. Returns False if the copy has no generator with such a state."""
        return self._loop.set_random_state(copy, packed)

    def save(self) -> list[SavedCopy]:
        """Save the state of each copy. Raises `CopyFailed` if a copy raises, and `CannotSave` if a state can't be kept."""
        states = []
        with self._activity.during(STEPPING):
            for n, env in enumerate(self.envs):
                try:
                    states.append(save(env))
                except CannotSave:
                    raise
                except BaseException as error:
                    raise CopyFailed(n, "save_state") from error
        return states

    def load(self, copy: int, state: SavedCopy) -> str:
        """Load a state into this copy, after a reset. Returns why that failed; empty if it succeeded."""
        try:
            with self._activity.during(STEPPING):
                load(self.envs[copy], state)
        except Exception as error:  # perhaps another version of the environment saved the state
            return f"load_state raised {type(error).__name__}: {first_line(error, 'no message')}"
        return ""

    def begun(self, over: Sequence[int]) -> dict[int, bytes | None]:
        """The random states from which episodes begin, by copy.

        For each copy that a step has reset since `begun` was last called, this is the state from which the copy's newest
        episode began. For copies that are `over`, it is the state from which the next episode will begin. It is None if the
        copy has no readable generator.
        """
        loop = self._loop
        states = loop.random_states | {n: loop.random_state(n) for n in over}
        loop.random_states = {}
        return {n: pack_random_state(state) for n, state in states.items()}

    def assign(self, name: str, packed: bytes, pulse: Pulse) -> None:
        """Set an attribute of every copy, on the outermost wrapper that has it."""
        self._attributes[name] = packed
        with self._activity.during(STEPPING):
            for n, env in enumerate(self.envs):
                set_attribute(n, env, name, unpack(packed))  # each copy gets its own value, because it may change the value

    def render(self, copy: int) -> Any:
        """The frame that this copy renders. Raises `CopyFailed`."""
        try:
            with self._activity.during(EVALUATING):
                return self.envs[copy].render()
        except BaseException as error:
            raise CopyFailed(copy, "render") from error

    def _read_masks(self, masks: MaskReader, infos: CopyInfos, copies: Sequence[int] | None) -> Leaves:
        return masks.read_loop(self._observations, infos, self._loop.terminated, self._loop.truncated, copies)

    def _leaves(self) -> Leaves:
        if self._nested:
            return read_leaves(self._read, self._observations)
        return (self._observations,)

    def close(self) -> None:
        """Close every copy. Exceptions of the copies are ignored."""
        self._loop.close()


def without_order_check(env: gymnasium.Env[Any, Any], which: EnvCopy = FIRST_COPY) -> gymnasium.Env[Any, Any]:
    """The environment without `OrderEnforcing`, which only checks that the first step follows a reset.

    The collector always resets first, and the wrapper makes a CartPole step a twentieth slower.
    """
    while type(env) is OrderEnforcing:
        env = env.env
    if isinstance(env, gymnasium.Wrapper):
        env.env = without_order_check(env.env)
    return env


def set_attribute(copy: int | None, env: Any, name: str, value: Any) -> None:
    """Set a public attribute of the environment or of one of its wrappers. Raises `CopyFailed` if none has it."""
    while isinstance(env, VectorWrapper) and not hasattr(env, name):
        env = env.env
    if isinstance(env, gymnasium.Env):
        found = env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else None
    else:
        found = getattr(env, name, None)
    try:
        there = not name.startswith("_") and not callable(found) and _assign_existing(env, name, value)
    except BaseException as error:
        raise CopyFailed(copy, f"set_env_attr {name}") from error
    if not there:
        what = "a private one" if name.startswith("_") else "a method" if callable(found) else "none"
        raise CopyFailed(copy, line=f"expected an attribute of the environment that is called {name}, got {what}")


def _assign_existing(env: Any, name: str, value: Any) -> bool:
    """Set the attribute if it exists. Returns whether it does."""
    if isinstance(env, gymnasium.Env):
        return env.set_wrapper_attr(name, value, force=False)
    if there := hasattr(env, name):
        setattr(env, name, value)
    return there
