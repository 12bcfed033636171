"""Each rule by which the learner refuses what a worker sends is found by the worker first, if an environment can break it.

The learner refuses the worker, and people would read that a worker is hostile, not which environment is wrong. So every
text of a refusal stands in one of two tables here: with environments that break its rule, and what the worker says of
them; or with the reason why no environment can. A new rule fails the first test until it stands in one of them.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.action_masks import has_mask, without_mask
from millrace.protocol.envs.description import describe_env
from millrace.protocol.envs.seats import SeatedEnv
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import EnvironmentFailed, UsageError
from millrace.protocol.messages import Evaluate
from millrace.protocol.rollout import Episode
from millrace.protocol.space_spec import MAX_DEPTH, MAX_ELEMENTS, MAX_LEAVES, MAX_SEATS
from millrace.protocol.specs import PolicySpec, RunSpec
from millrace.workers.evaluate.evaluator import Evaluator
from tests.support.conversation.example_messages import example
from tests.support.in_process.collectors import collect, no_pulse, random_collector, random_policy

ROOT = Path(__file__).parents[2]
WHERE = (
    *(f"protocol/rows/{name}.py" for name in ("array_checks", "rollout_checks", "played", "stepped")),
    *(f"protocol/envs/{name}.py" for name in ("description", "space_records", "space_generators")),
    "protocol/space_spec.py",
    *(f"learner/rollouts/{name}.py" for name in ("evaluation_dealer", "rollout_dealer")),
    *(f"learner/vector_env/{name}.py" for name in ("order_coordinator", "infos", "calls")),
)
"""The files that say why what a worker sent is refused. What decoding refuses are bounds of fields, which senders keep."""


def rules(source: str) -> Iterator[str]:
    """The texts of refusals: all that say what was expected, `{}` for what is filled in."""
    tree = ast.parse((ROOT / source).read_text())
    nodes = list(ast.walk(tree))
    docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    parts = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in ast.walk(node) if part is not node}
    for node in nodes:
        if id(node) in docstrings | parts:
            continue
        match node:
            case ast.JoinedStr(values):
                text = "".join(str(each.value) if isinstance(each, ast.Constant) else "{}" for each in values)
            case ast.Constant(str(text)):
                pass
            case _:
                continue
        if "expected" in text:
            yield text


# ----------------------------------------------------------------------------------------------------------- environments


class One(gymnasium.Env[Any, Any]):
    """One agent. Returns `seen` and `reward` from the second step on, and pictures of these `sizes`."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}

    def __init__(
        self,
        seen: Any = None,
        reward: Any = 1.0,
        space: spaces.Space[Any] | None = None,
        sizes: tuple[int, ...] = (4,),
        **wrong: Any,
    ) -> None:
        self.observation_space = space or spaces.Box(-9, 9, (2,), np.float32)
        self.action_space = wrong.get("action") or spaces.Discrete(2)
        self.render_mode = "rgb_array"
        self._good = self.observation_space.sample()
        if isinstance(self._good, dict) and "action_mask" in self._good:
            self._good["action_mask"] = np.ones(2, np.int8)
        self._seen, self._reward, self._sizes = self._good if seen is None else seen, reward, sizes

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.t = 0
        return self._good, {}

    def step(self, action: Any) -> Any:
        self.t += 1
        later = self.t > 1
        return self._seen if later else self._good, self._reward if later else 1.0, self.t == 5, False, {}

    def render(self) -> Any:
        return np.zeros((self._sizes[self.t % len(self._sizes)], 4, 3), np.uint8)


class Two:
    """Two agents that act together: `a` ends in step 2, the episode in step 4, and what is `wrong` begins then."""

    possible_agents = ("a", "b")
    metadata: dict[str, Any] = {}

    def __init__(self, wrong: str = "", paid: float = 1.0) -> None:
        self.wrong, self.paid = wrong, paid

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Box(0, 9, (1,), np.float32)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Discrete(2)

    def _seen(self) -> dict[str, Any]:
        return {agent: np.zeros(1, np.float32) for agent in "ab"}

    def reset(self, seed: int | None = None) -> Any:
        self.t, self.agents = 0, ["a", "b"]
        return self._seen(), {}

    def step(self, actions: Any) -> Any:
        self.t += 1
        self.agents = ["a", "b"] if self.t < 2 or self.wrong in ("stays", "ends again") else ["b"]
        if self.wrong == "comes back" and self.t == 3:
            self.agents = ["a", "b"]
        a_ends = self.wrong != "leaves" and (self.t == 2 or (self.wrong == "ends again" and self.t > 2))
        rewards = {"a": 1.0 if self.t < 3 else self.paid, "b": 1.0}
        return self._seen(), rewards, {"a": a_ends, "b": self.t == 4}, dict.fromkeys("ab", False), {}


class InTurns(Two):
    """They move in turn. The episode ends after four moves, and `b` leaves without being selected if that is `wrong`."""

    def agent_iter(self) -> None: ...

    def reset(self, seed: int | None = None) -> None:
        self.t, self.agents, self.agent_selection = 0, ["a", "b"], "a"

    def last(self) -> Any:
        return np.zeros(1, np.float32), self.paid if self.t == 0 else 1.0, self.t >= 4, False, {}

    def step(self, action: Any) -> None:
        mover = self.agent_selection
        if self.t >= 4:
            self.agents = [] if self.wrong == "leaves" else [agent for agent in self.agents if agent != mover]
        self.t += self.t < 4
        self.agent_selection = "b" if mover == "a" else "a"


def run_on(make: Callable[[], Any]) -> RunSpec:
    """A run on this environment, which is made anew for each copy."""
    spec = EnvSpec.of(make)
    env = spec.make()
    masked = has_mask(env.observation_space, env.action_space)
    space = without_mask(env.observation_space, env.action_space) if masked else env.observation_space
    policy = PolicySpec(observation_leaves(space), action_spec(env.action_space))
    seats = env.seats if isinstance(env, SeatedEnv) else ()
    turns = isinstance(env, SeatedEnv) and env.takes_turns
    return RunSpec(spec, policy, 8, 2, 1, seed=1, masked=masked, seats=seats, takes_turns=turns)


def collected(make: Callable[[], Any]) -> str:
    """What the worker says of this environment when it collects; empty if the learner takes the rollouts."""
    run = run_on(make)
    try:
        collector = random_collector(run)
        for sequence in range(3):
            collect(collector, run, sequence)
    except EnvironmentFailed as error:
        return str(error)
    return ""


def evaluated(make: Callable[[], Any], frames: bool = False) -> str:
    """The same in an evaluation."""
    run = run_on(make)
    order = example(
        Evaluate, session=1, ticket=1, seeds=(3, 4), greedy=True, most_steps=50, send_rows=True, send_frames=frames
    )
    try:
        Evaluator(run, random_policy(run.policy)).play(order, lambda rows: None, no_pulse)
    except EnvironmentFailed as error:
        return str(error)
    return ""


def filmed(make: Callable[[], Any]) -> str:
    return evaluated(make, frames=True)


def described(make: Callable[[], Any]) -> str:
    """What the worker says of this environment when it describes it."""
    try:
        describe_env(EnvSpec.of(make).make())
    except UsageError as error:
        return str(error)
    return ""


class Case(NamedTuple):
    """An environment, what a worker does with it, and how its error begins. Nothing: the learner takes what comes of it."""

    does: Callable[[Callable[[], Any]], str]
    make: Callable[[], Any]
    says: str


def bad_box(low: Any) -> spaces.Box:
    """A Box whose bounds were changed after it was made."""
    box = spaces.Box(-1, 1, (2,), np.float32)
    box.low = np.asarray(low)
    return box


def nested(levels: int) -> spaces.Space[Any]:
    space: spaces.Space[Any] = spaces.Discrete(2)
    for _ in range(levels):
        space = spaces.Tuple([space])
    return space


def agents(*names: Any) -> Callable[[], Any]:
    def make() -> Any:
        env: Any = Two()
        env.possible_agents = names
        return env

    return make


MASKED = spaces.Dict({"seen": spaces.Discrete(3), "action_mask": spaces.Box(0, 1, (2,), np.int8)})
NO_CHOICE = {"seen": 0, "action_mask": np.zeros(2, np.int8)}
TWO_PARTS = spaces.Dict({"x": spaces.Discrete(3), "y": spaces.Discrete(3)})
WRONG_MD = spaces.MultiDiscrete([3, 2**60])

EVALUATED = "while the policy was evaluated:"

FOUND_BY_THE_WORKER: dict[str, tuple[Case, ...]] = {
    "expected finite values, got {}": (
        Case(
            collected, lambda: One(np.array([0, np.nan], np.float32)), "lane 0, observation: expected finite values, got nan"
        ),
        Case(collected, lambda: One(reward=1e300), "lane 0, reward: expected finite values, got inf at step 1, copy 0"),
        Case(evaluated, lambda: One(reward=np.nan), f"{EVALUATED} reward: expected finite values, got nan"),
    ),
    "expected {} to {}, got {}": (
        Case(
            collected,
            lambda: One(3, space=spaces.Discrete(3)),
            "lane 0, observation: expected 0 to 2, got 3 at step 2, copy 0",
        ),
        Case(evaluated, lambda: One(3, space=spaces.Discrete(3)), f"{EVALUATED} observation: expected 0 to 2"),
    ),
    "expected {}{}, got {}; is its environment the same version?": (
        Case(
            collected, lambda: One(np.zeros(3)), "lane 0, copy 0, step 1: observation: expected float32[2] as its space says"
        ),
        Case(collected, lambda: One(reward=[1, 2]), "lane 0, copy 0, step 1: reward: expected a number, got an array"),
    ),
    "observation: expected {} arrays, got {}": (
        Case(
            collected,
            lambda: One({"x": 1}, space=TWO_PARTS),
            "lane 0, copy 0, step 1: observation: expected the structure of",
        ),
    ),
    "mask: expected an allowed choice at {}, got none": (
        Case(
            collected,
            lambda: One(NO_CHOICE, space=MASKED),
            "lane 0, copy 0, step 1: action_mask: expected 2 zeros and ones of",
        ),
    ),
    "expected a finite return of 1 to {} float32 rewards and a duration, got {}": (
        Case(collected, lambda: Two(paid=np.nan), "lane 0, reward: expected finite values, got nan at step 2, copy 0, a"),
        Case(collected, lambda: Two(paid=1e300), "lane 0, reward: expected finite values, got inf at step 2, copy 0, a"),
        Case(
            collected, lambda: InTurns(paid=-np.inf), "lane 0, reward: expected finite values, got -inf at step 0, copy 0, a"
        ),
        Case(evaluated, lambda: Two(paid=np.inf), f"{EVALUATED} reward: expected finite values, got inf at step 2"),
        Case(evaluated, lambda: InTurns(paid=1e300), f"{EVALUATED} reward: expected finite values, got inf"),
    ),
    "valid: expected none of a seat whose part of the episode has ended": tuple(
        Case(does, lambda wrong=wrong: Two(wrong), "")  # type: ignore[misc]
        for does in (collected, evaluated)
        for wrong in ("stays", "comes back", "ends again")
    ),
    "valid: expected no gap after a row that has not ended, because no agent waits for others": (
        Case(
            collected,
            lambda: Two("leaves"),
            "lane 0, copy 0, step 1: agent a left, expected it to be terminated or truncated",
        ),
        Case(evaluated, lambda: Two("leaves"), f"{EVALUATED} copy 0, step 1: agent a left, expected it to be"),
    ),
    "resets: expected none before the part of each seat has ended": (
        Case(
            collected,
            lambda: InTurns("leaves"),
            "lane 0, copy 0, step 3: agent b left, expected it to be selected once more",
        ),
    ),
    "frames: expected the size of the first ones, got {}": (
        Case(filmed, lambda **_: One(sizes=(4, 5)), f"{EVALUATED} copy 0, render: expected frames of one size"),
    ),
    "frames: expected uint8[{}, H, W, 3], got {}{}": (
        Case(filmed, lambda **_: One(sizes=(0,)), f"{EVALUATED} copy 0, render: expected an array [H, W, 3]"),
    ),
    "seats: expected agents of different names, or none, got {}": (
        Case(described, agents("a", "a"), "environment <make>: possible_agents: expected agents of different names"),
        Case(
            described,
            agents(1, "1"),
            "environment <make>: possible_agents: expected agents of different names, got 1 and '1'",
        ),
    ),
    "environment: expected at most {} agents, got {}": (
        Case(described, agents(*map(str, range(MAX_SEATS + 1))), f"environment: expected at most {MAX_SEATS} agents, got"),
    ),
    "{}: expected at most {} levels of Dict and Tuple, got more": (
        Case(
            described, lambda: One(space=nested(MAX_DEPTH + 1)), "observation space: expected at most 8 levels of Dict and"
        ),
    ),
    "space: expected at most {} levels of Dict and Tuple, got more": (
        Case(
            described, lambda: One(action=nested(MAX_DEPTH + 1)), "action space: expected at most 8 levels of Dict and Tuple"
        ),
    ),
    "{}: expected at most {} arrays, got {}": (
        Case(
            described,
            lambda: One(action=spaces.Tuple([spaces.Discrete(2)] * (MAX_LEAVES + 1))),
            "action space: expected at most",
        ),
        Case(
            described, lambda: One(action=spaces.Tuple([TWO_PARTS] * MAX_LEAVES)), "action space: expected at most 48 arrays"
        ),
    ),
    "{}: expected at most {} elements, got {}": (
        Case(described, lambda: One(action=spaces.MultiBinary(MAX_ELEMENTS + 1)), "action space: expected at most 16777216"),
    ),
    "Box space: {}: expected {}{} or one {}, got {}{}": (
        Case(
            described, lambda: One(action=bad_box(np.zeros(3))), "action space: Box space: low: expected float32(2,) or one"
        ),
    ),
    "Box space: {}: expected numbers or infinities, got NaN": (
        Case(
            described,
            lambda: One(action=bad_box(np.array([np.nan, 0], np.float32))),
            "action space: Box space: low: expected numbers",
        ),
    ),
    "MultiDiscrete space: expected entries of 1 to {} values, got {} to {}": (
        Case(described, lambda: One(action=WRONG_MD), "action space: MultiDiscrete space: expected entries of 1 to"),
    ),
    "{}: expected keys of a Dict that are text of at most {} characters, got {}": (
        Case(
            described,
            lambda: One(action=spaces.Dict({"x" * 201: spaces.Discrete(2)})),
            "action space: expected keys of a Dict",
        ),
    ),
}

SHAPES, COUNTS = "the worker allocates its arrays by the run, and writes into them", "the worker counts it itself"
NO_ENVIRONMENT_CAN: dict[str, str] = {
    "expected bytes 0 and 1, got {}": "flags are written into arrays of bool, which makes them 0 and 1",
    "mask: expected {}": SHAPES,
    "resets: expected {}": SHAPES,
    "extras: expected {} arrays, got {}": f"{SHAPES}; a policy's own are refused as the policy's failure",
    "lane: expected 0 to {}, got {}": "the ticket names the lane",
    "episodes: expected {}, got {}": COUNTS,
    "valid: expected {} at step {}, copy {}, got {}": "valid is made of the flags by this rule",
    "valid: expected no end in a row that is not valid": "flags are written for complete rows alone (`SeatStep`)",
    "valid: expected none in a step that only resets the copy": "a reset completes no row (`SeatStep`)",
    "resets: expected none right before another": "a copy whose reset leaves nobody who acts is an error",
    "action: expected one that the mask allows at {}, got {}": "the policy chooses; the user's own fails as a policy",
    "expected {} facts, got {}": "the worker makes one number of each name",
    "expected finite facts, got {}": "what is not finite is missing, which is NaN; returns are sums of checked rewards",
    "expected {}, got {}": "the order says whether there is an opponent",
    "expected an opponent from {}, got {}": "the order names the opponent",
    "expected the score 0, {}, got {}": "the worker counts it from returns, which are finite",
    "expected none after the end of their episode": COUNTS,
    "expected 1 to {} rows, got reward {}": COUNTS,
    "expected an end only in the last row": "the worker sends rows when an episode ends",
    "frames: expected {}": "the order says whether there are frames",
    "frames: expected those of the first observations": "a picture is taken of every observation up to the most",
    "metadata: expected at most {} bytes, got {}": "entries that would make it longer are left out",
    "metadata: expected a dict with names as keys, got {}": "the worker makes the dict, of entries whose keys are text",
    "spec: expected gymnasium's as JSON: {}": "a spec that cannot be read back is left out",
    "MultiDiscrete space: expected nvec and start of one shape and int64, got {}{} and {}{}": "the worker makes them int64, "
    "and gymnasium makes their shapes equal",
    "{}: expected a dtype of whole numbers, got {}": "gymnasium refuses such a space",
    "{}: expected values that fit {}, got {} to {}": "gymnasium refuses such a space",
    "Dict space: expected a different key for each of {} spaces, got {}": "keys of a dict differ",
    "generators: expected one for each of {} spaces, got {}": "the worker describes the one of each space, or none",
    "rows of ticket {}: expected an episode below {}, got {}": COUNTS,
    "expected {} episodes, got {} and {} marks of cut ones": COUNTS,
    "expected the opponents {}, got {}": "the order names them",
    "begun: expected each of the copies 0 to {} at most once, got {}": COUNTS,
    "begun: expected starts up to {}, got {}": COUNTS,
    "saved: expected copies 0 to {}, each at most once, got {}": COUNTS,
    "memory: expected at most {} bytes, got {}": SHAPES,
    "numbers: expected {}, got {}": "the ticket names the lane, the version and the sequence",
    "answer: expected one from another lane, got one from lane {}": "the order names the lane",
    "answer: expected one of incarnation {}, got one of {}": "the order names the incarnation",
    "answer to {}: expected {}, got {}": "the kind of answer follows from the order",
    "results: expected a list of {}, got {}": "the worker makes the list",
    "answer to an order through shared memory: expected Stepped, got Returned": "the kind of answer follows from the order",
    "expected pairs of a number and a dict, got {} and {}": "an info that is no dict is the environment's failure",
    "call: expected the name of an attribute, text of 1 to {} characters, got {}": "that is what a caller of ours gives",
    "expected the frames of a message, got {}": "the worker encodes the description",
    "expected Described, got {}": "the worker encodes the description",
}


def test_every_refusal_is_found_by_the_worker_or_is_no_environment_s() -> None:
    found = {text for source in WHERE for text in rules(source)}
    told = FOUND_BY_THE_WORKER.keys() | NO_ENVIRONMENT_CAN.keys()
    assert found - told == set(), "say which environment breaks this rule, and what its worker says, or why none can"
    assert told - found == set(), "the learner has this rule no more"
    assert not FOUND_BY_THE_WORKER.keys() & NO_ENVIRONMENT_CAN.keys()


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=f"{rule[:50]} {number}")
        for rule, cases in FOUND_BY_THE_WORKER.items()
        for number, case in enumerate(cases)
    ],
)
def test_the_worker_says_which_environment_it_is(case: Case) -> None:
    said = case.does(case.make)
    assert said.startswith(case.says)
    assert bool(said) == bool(case.says)
    assert "\n" not in said


@pytest.mark.parametrize("make", [One, Two, InTurns])
def test_environments_that_are_right_are_used(make: Callable[[], Any]) -> None:
    assert collected(make) == evaluated(make) == described(make) == ""


def test_the_largest_rewards_make_a_return_that_the_learner_takes() -> None:
    """They are rounded to the largest float32 number, and their sum before that is larger."""
    assert collected(lambda: One(reward=3.4028235e38 * (1 + 1e-8))) == ""


def test_whatever_its_reason_is_a_worker_sends_no_episode_that_the_learner_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    counted = "millrace.workers.lanes.running_episodes.whole_episode"
    monkeypatch.setattr(counted, lambda *_: Episode(1e300, 1, 0.0, (0.0, 0.0)))
    assert collected(Two).startswith("lane 0, copy 0, episode: expected a finite return of 1 to ")
    monkeypatch.setattr(counted, lambda *_: Episode(1.0, 51, 0.0, (0.0, 0.0)))
    assert evaluated(Two).startswith("while the policy was evaluated: copy 0, episode: expected a finite return of 1 to 50")
