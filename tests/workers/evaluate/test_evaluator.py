"""The evaluator: episodes that depend on their seeds and the weights alone, and errors that name the copy and the step."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from gymnasium import spaces

from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import EnvironmentFailed, UsageError
from millrace.protocol.messages import EpisodeRows, Evaluate, Evaluated, Permit
from millrace.protocol.policy.policy import Policy
from millrace.protocol.specs import PolicySpec, RunSpec
from millrace.protocol.wire.codec import encode
from millrace.workers.collect.collector import Collector
from millrace.workers.evaluate import episode_rows
from millrace.workers.evaluate.evaluator import ROWS_AT_ONCE, Evaluator
from tests.support.conversation.example_messages import example
from tests.support.in_process.collectors import no_pulse, random_policy, run_of
from tests.workers.collect.test_seat_rows import FORMS, seated_run

Array = np.ndarray[Any, Any]


class Echo(gymnasium.Env[Any, Any]):
    """Shows a number; reward 1 for repeating it, 0 otherwise. Episodes last 3 plus the seed's last digit, or never end."""

    made: list[Echo] = []

    def __init__(self, fails_at: int = 0, endless: bool = False, bad: str = "", bad_from: int = 0) -> None:
        self.observation_space = spaces.Discrete(5)
        self.action_space = spaces.Discrete(5)
        self.seeds: list[int | None] = []
        self.closed, self.steps, self.stepped, self.number = False, 0, 0, 0
        self.fails_at, self.endless, self.bad, self.bad_from = fails_at, endless, bad, bad_from
        Echo.made.append(self)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.steps, self.longest = 0, 3 + (seed or 0) % 10
        return self._next(), {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self.steps += 1
        self.stepped += 1
        if self.steps == self.fails_at:
            raise RuntimeError("the spring broke\nin two")
        right: Any = float(action == self.number)
        bad = self.bad if self.steps > self.bad_from else ""
        right = {"reward": float("nan"), "text": "one"}.get(bad, right)
        observation = {"shape": np.zeros(2, np.int64), "outside": 7}.get(bad, self._next())
        return observation, right, not self.endless and self.steps == self.longest, False, {}

    def _next(self) -> int:
        self.number = int(self.np_random.integers(5))
        return self.number

    def close(self) -> None:
        self.closed = True


gymnasium.register("millrace-tests/EvaluatedEcho-v0", entry_point=lambda **kwargs: Echo(**kwargs))


class Repeats:
    """A policy that repeats what it sees, or always takes the same action."""

    def __init__(self, always: int | None = None) -> None:
        self.always = always
        self.shapes: set[tuple[int, ...]] = set()

    def load(self, parameters: Any, buffers: Any) -> None:
        pass

    def __call__(self, leaves: Sequence[Array], state: Array | None = None) -> Any:
        (seen,) = leaves
        self.shapes.add(seen.shape)
        return np.eye(5, dtype=np.float32)[seen if self.always is None else np.full_like(seen, self.always)] * 50


@pytest.fixture
def made() -> list[Echo]:
    Echo.made.clear()
    return Echo.made


def echo_run(**kwargs: Any) -> RunSpec:
    policy = PolicySpec(observation_leaves(spaces.Discrete(5)), action_spec(spaces.Discrete(5)))
    env = EnvSpec("millrace-tests/EvaluatedEcho-v0", kwargs)
    return RunSpec(env, policy, rollout_steps=4, copies=1, lanes=1, seed=1)


def order(*seeds: int, most_steps: int = 1_000, greedy: bool = True, **settings: bool) -> Evaluate:
    return example(
        Evaluate,
        session=3,
        ticket=70,
        seeds=seeds,
        greedy=greedy,
        most_steps=most_steps,
        send_rows=settings.get("rows", False),
        send_frames=settings.get("frames", False),
    )


def play(evaluator: Evaluator, asked: Evaluate) -> Evaluated:
    def never(rows: EpisodeRows) -> None:
        raise AssertionError("rows were sent without being asked for")

    return evaluator.play(asked, never, no_pulse)


def figures(answer: Evaluated) -> list[tuple[float, int]]:
    return [(episode.reward, episode.length) for episode in answer.episodes]


def test_each_seed_gives_one_episode_in_the_order_of_the_seeds(made: list[Echo]) -> None:
    policy = Repeats()
    evaluator = Evaluator(echo_run(), policy)
    answer = play(evaluator, order(5, 0, 9))
    assert figures(answer) == [(8.0, 8), (3.0, 3), (12.0, 12)]
    assert answer.cut == (False, False, False)
    assert (answer.session, answer.ticket) == (3, 70)
    assert policy.shapes == {(1, 3)}, "the shape of the batch changed"
    assert [env.stepped for env in made] == [8, 3, 12], "a copy was stepped after its episode"
    assert evaluator.steps == 23
    assert evaluator.seconds > 0


def test_copies_that_play_evaluations_have_arguments_of_their_own(made: list[Echo]) -> None:
    run = echo_run(endless=True, fails_at=2)
    env = msgspec.structs.replace(run.env, eval_kwargs={"fails_at": 0})
    answer = play(Evaluator(msgspec.structs.replace(run, env=env), Repeats()), order(5, most_steps=20))
    assert figures(answer) == [(20.0, 20)]
    assert [(env.endless, env.fails_at) for env in made] == [(True, 0)]


def test_copies_are_kept_for_the_next_order_and_closed_at_the_end(made: list[Echo]) -> None:
    evaluator = Evaluator(echo_run(), Repeats())
    first = play(evaluator, order(1, 2, 3))
    play(evaluator, order(4, 5))
    assert figures(play(evaluator, order(1, 2, 3))) == figures(first)
    assert [env.seeds for env in made] == [[1, 4, 1], [2, 5, 2], [3, 3]]
    assert not any(env.closed for env in made)
    evaluator.close()
    assert all(env.closed for env in made)


@pytest.mark.parametrize("env", ["CartPole-v1", "Pendulum-v1"])
@pytest.mark.parametrize("core", [None, "lstm"])
@pytest.mark.parametrize("greedy", [True, False])
def test_the_result_depends_on_the_order_alone(env: str, core: Any, greedy: bool) -> None:
    run = run_of(env, core=core)
    busy, fresh = (Evaluator(run, random_policy(run.policy)) for _ in range(2))
    play(busy, order(8, 9, 10, 11, 12, most_steps=40, greedy=greedy))
    asked = order(1, 2, 3, most_steps=150, greedy=greedy)
    assert figures(play(busy, asked)) == figures(play(fresh, asked))
    other = figures(play(fresh, order(4, 2, 3, most_steps=150, greedy=greedy)))
    assert other[0] != figures(play(fresh, asked))[0], "the seed changes nothing"


def test_sampled_actions_are_not_the_greedy_ones_and_repeat_for_the_seeds() -> None:
    run = run_of("CartPole-v1")
    evaluator = Evaluator(run, random_policy(run.policy))
    sampled, again, greedy = (figures(play(evaluator, order(1, 2, greedy=how))) for how in (False, False, True))
    assert sampled == again != greedy


def test_an_episode_without_end_is_cut_and_said() -> None:
    answer = play(Evaluator(echo_run(endless=True), Repeats()), order(1, 2, most_steps=50))
    assert answer.cut == (True, True)
    assert [length for _, length in figures(answer)] == [50, 50]
    ends = play(Evaluator(echo_run(), Repeats()), order(7, 9, most_steps=10))
    assert ends.cut == (False, True), "an episode that ends at its last allowed step was not cut"


class Smooth(gymnasium.Env[Any, Any]):
    """The reward is how little the action has changed. It keeps its last action: the array that it was given, or a copy."""

    def __init__(self, copies: bool) -> None:
        self.observation_space = spaces.Box(-1, 1, (2,))
        self.action_space = spaces.Box(-1, 1, (2,))
        self.copies, self.last = copies, np.zeros(2, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.last, self.steps = np.zeros(2, np.float32), 0
        return self.show(), {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self.steps += 1
        change = np.abs(action - self.last).sum()
        self.last = action.copy() if self.copies else action
        return self.show(), -float(change), self.steps == 5, False, {}

    def show(self) -> Any:
        return self.np_random.uniform(-1, 1, 2).astype(np.float32)


def test_an_environment_may_keep_its_action() -> None:
    policy = PolicySpec(observation_leaves(Smooth(True).observation_space), action_spec(Smooth(True).action_space))

    def returns(copies: bool) -> list[tuple[float, int]]:
        run = RunSpec(EnvSpec.of(lambda: Smooth(copies)), policy, rollout_steps=4, copies=1, lanes=1, seed=1)
        return figures(play(Evaluator(run, random_policy(policy)), order(1, 2, greedy=False)))

    assert returns(copies=False) == returns(copies=True)


def test_an_environment_that_raises_is_named_with_its_traceback(made: list[Echo]) -> None:
    with pytest.raises(EnvironmentFailed) as caught:
        play(Evaluator(echo_run(fails_at=2), Repeats()), order(1, 2))
    expected = "while the policy was evaluated: copy 0, step 1: its environment raised RuntimeError: the spring broke"
    assert str(caught.value) == expected
    assert "in step" in caught.value.detail
    assert all(env.closed for env in made)


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        ("reward", "while the policy was evaluated: reward: expected finite values, got nan at step 0, copy 0"),
        ("text", "copy 0, step 0: reward: expected a number, got 'one'"),
        ("shape", r"copy 0, step 0: observation: expected int64\[\] as its space says, got int64\[2\]"),
        ("outside", "while the policy was evaluated: observation: expected 0 to 4, got 7 at step 1, copy 0"),
    ],
)
def test_an_unusable_value_is_named(bad: str, says: str) -> None:
    with pytest.raises(EnvironmentFailed, match=says):
        play(Evaluator(echo_run(bad=bad), Repeats()), order(1))


@pytest.mark.parametrize(("bad", "step"), [("reward", 18), ("outside", 19)])
def test_an_unusable_value_is_named_by_its_step_in_a_long_episode(bad: str, step: int) -> None:
    assert step > ROWS_AT_ONCE
    with pytest.raises(EnvironmentFailed, match=f"at step {step}, copy 0"):
        play(Evaluator(echo_run(bad=bad, bad_from=18, endless=True), Repeats()), order(1, 2))


def test_steps_are_counted_as_they_are_made(made: list[Echo]) -> None:
    evaluator = Evaluator(echo_run(endless=True), Repeats())
    seen: list[tuple[int, int]] = []

    def pulse() -> None:
        seen.append((evaluator.steps, sum(env.stepped for env in made)))

    for asked in (order(1, 2, most_steps=2 * ROWS_AT_ONCE + 1), order(5, most_steps=3)):
        evaluator.play(asked, lambda rows: None, pulse)
    assert [counted for counted, _ in seen] == [stepped for _, stepped in seen]
    assert evaluator.steps == 2 * (2 * ROWS_AT_ONCE + 1) + 3


class Shows(Smooth):
    """Shows zeros, and from this step on another number. Its episodes have two steps."""

    def __init__(self, shown: float, at: int) -> None:
        super().__init__(copies=True)
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.shown, self.at = shown, at

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, *_ = super().step(action)
        return observation, 0.0, self.steps == 2, False, {}

    def show(self) -> Any:
        return np.full(2, self.shown if self.steps >= self.at else 0.0)


def run_of_shown(shown: float, at: int) -> RunSpec:
    env = Shows(shown, at)
    policy = PolicySpec(observation_leaves(env.observation_space), action_spec(env.action_space))
    return RunSpec(EnvSpec.of(lambda: Shows(shown, at)), policy, rollout_steps=4, copies=1, lanes=1, seed=1)


def test_an_observation_from_which_no_policy_can_act_is_named_as_in_training() -> None:
    run = run_of_shown(1e39, at=1)
    says = "action of the policy: expected finite values, got nan at step 1, copy 0, from observations up to 1e[+]39; wrap"
    with pytest.raises(EnvironmentFailed, match=f"while the policy was evaluated: {says}"):
        play(Evaluator(run, random_policy(run.policy)), order(1, 2))
    with pytest.raises(EnvironmentFailed, match=f"lane 0, {says}"):
        Collector(run, random_policy(run.policy)).collect([Permit(0, 0, 0, 0, 0)], 0, 1, no_pulse)


def test_no_row_is_sent_with_an_observation_that_is_not_finite() -> None:
    run, sent = run_of_shown(np.nan, at=2), list[EpisodeRows]()
    with pytest.raises(EnvironmentFailed, match="observation: expected finite values, got nan at step 2, copy 0"):
        Evaluator(run, random_policy(run.policy)).play(order(1, rows=True), sent.append, no_pulse)
    assert not sent


def test_an_environment_of_other_spaces_is_refused() -> None:
    run = msgspec.structs.replace(run_of("CartPole-v1"), env=EnvSpec("Acrobot-v1"))
    with pytest.raises(UsageError, match=r"environment Acrobot-v1: its observations .* are not those of the policy"):
        play(Evaluator(run, random_policy(run.policy)), order(1))


def test_a_pulse_that_raises_ends_the_evaluation_and_is_not_the_environments_fault(made: list[Echo]) -> None:
    beats = iter(range(10))

    def pulse() -> None:
        if next(beats) == 8:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        Evaluator(echo_run(endless=True), Repeats()).play(order(1, 2), lambda rows: None, pulse)
    assert all(env.closed for env in made)
    assert 0 < made[0].stepped < 8


def test_rows_are_cut_into_messages_and_are_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episode_rows, "CHUNK_BYTES", 200)
    run = run_of("CartPole-v1")
    sent: list[EpisodeRows] = []
    policy: Policy = random_policy(run.policy)
    answer = Evaluator(run, policy).play(order(1, 2, most_steps=12, rows=True), sent.append, no_pulse)
    for n, episode in enumerate(answer.episodes):
        chunks = [rows for rows in sent if rows.episode == n]
        assert len(chunks) > 1
        assert [rows.first_step for rows in chunks] == np.cumsum([0, *(len(rows.reward) for rows in chunks[:-1])]).tolist()
        assert sum(len(rows.reward) for rows in chunks) == episode.length
        assert sum(float(rows.reward.sum()) for rows in chunks) == episode.reward
        for rows, following in pairwise(chunks):
            assert len(rows.obs[0]) == len(rows.action) + 1
            assert rows.obs[0][-1].tobytes() == following.obs[0][0].tobytes()
            assert not (rows.terminated | rows.truncated).any()
        assert bool(chunks[-1].truncated[-1]) is answer.cut[n]
        assert bool(chunks[-1].terminated[-1]) is not answer.cut[n]
    env = gymnasium.make("CartPole-v1")
    first = env.reset(seed=1)[0]
    assert sent[0].obs[0][0].tolist() == first.tolist()


@pytest.mark.parametrize("limit", [1, 200, 300, 10_000])
@pytest.mark.parametrize("form", ["one agent", *FORMS])
@pytest.mark.parametrize("most_steps", [ROWS_AT_ONCE, ROWS_AT_ONCE + 1, 50])
def test_the_messages_do_not_depend_on_how_many_rows_are_played_at_once(
    monkeypatch: pytest.MonkeyPatch, limit: int, form: str, most_steps: int
) -> None:
    monkeypatch.setattr(episode_rows, "CHUNK_BYTES", limit)
    run = run_of("CartPole-v1") if form == "one agent" else seated_run(form, 4, 1)

    def sent(at_once: int) -> dict[int, list[bytes]]:
        monkeypatch.setattr("millrace.workers.evaluate.evaluator.ROWS_AT_ONCE", at_once)
        found: dict[int, list[bytes]] = {0: [], 1: [], 2: []}

        def keep(rows: EpisodeRows) -> None:
            found[rows.episode].append(b"".join(bytes(frame) for frame in encode(rows)))

        asked = order(1, 2, 7, greedy=False, most_steps=most_steps, rows=True)
        Evaluator(run, random_policy(run.policy)).play(asked, keep, no_pulse)
        return found

    assert sent(ROWS_AT_ONCE) == sent(1)


class Painted(Echo):
    """Renders its number of steps as the color of a picture, always in the same array if it has a canvas."""

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, render_mode: str | None = None, blank: bool = False, canvas: bool = False) -> None:
        super().__init__()
        self.render_mode, self.blank = render_mode, blank
        self.canvas = np.zeros((2, 3, 3), np.uint8) if canvas else None

    def render(self) -> Any:
        if self.canvas is not None:
            self.canvas[:] = self.steps
            return self.canvas
        return np.zeros((2, 3)) if self.blank else np.full((2, 3, 3), self.steps, np.uint8)


gymnasium.register("millrace-tests/Painted-v0", entry_point=lambda **kwargs: Painted(**kwargs))


class Blind(Painted):
    """Takes a render mode and renders nothing."""

    metadata: dict[str, Any] = {"render_modes": []}


gymnasium.register("millrace-tests/Unseen-v0", entry_point=lambda **kwargs: Blind(**kwargs))


def painted(**kwargs: Any) -> RunSpec:
    return msgspec.structs.replace(echo_run(), env=EnvSpec("millrace-tests/Painted-v0", kwargs))


@pytest.mark.parametrize("canvas", [False, True])
def test_a_frame_is_sent_of_every_observation_up_to_a_limit(monkeypatch: pytest.MonkeyPatch, canvas: bool) -> None:
    monkeypatch.setattr(episode_rows, "MOST_FRAMES", 6)
    sent: list[EpisodeRows] = []
    answer = Evaluator(painted(canvas=canvas), Repeats()).play(order(1, 9, frames=True), sent.append, no_pulse)
    assert [episode.length for episode in answer.episodes] == [4, 12]
    for n, colors in enumerate([[0, 1, 2, 3, 4], [0, 1, 2, 3, 4, 5]]):
        chunks = [rows for rows in sent if rows.episode == n]
        seen = [0]
        for rows in chunks:
            if rows.frames is not None:
                assert rows.frames.shape == (len(rows.obs[0]), 2, 3, 3)
                seen += rows.frames[1:, 0, 0, 0].tolist()
        assert seen == colors
        assert sum(len(rows.reward) for rows in chunks) == answer.episodes[n].length


def test_an_environment_without_metadata_is_evaluated(monkeypatch: pytest.MonkeyPatch) -> None:
    """As environments of the old package gym, which shimmy wraps."""
    monkeypatch.setattr(Echo, "metadata", None)
    assert figures(play(Evaluator(echo_run(), Repeats()), order(5))) == [(8.0, 8)]


def test_an_environment_that_cannot_be_filmed_is_refused() -> None:
    run = msgspec.structs.replace(echo_run(), env=EnvSpec("millrace-tests/Unseen-v0"))
    with pytest.raises(UsageError, match=r"Unseen-v0 cannot be filmed: expected it to render rgb_array, got \[\]"):
        Evaluator(run, Repeats()).play(order(1, frames=True), lambda rows: None, no_pulse)
    with pytest.raises(EnvironmentFailed, match=r"copy 0, render: expected an array \[H, W, 3\] of uint8, got float64"):
        Evaluator(painted(blank=True), Repeats()).play(order(1, frames=True), lambda rows: None, no_pulse)
