"""The checks of the environment profile: the learner chooses actions, and the client resets and steps on order.

Each check is a function listed in `profiles.py`, written as `script.py` explains. Its docstring says what the learner does
to the client.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import msgpack
import numpy as np
from msgspec.structs import replace

from millrace.extras.conformance.join_checks import (
    POLE_GAINS,
    begins,
    described,
    heartbeats,
    is_gymnasium_pole,
    over_a_new_connection,
    time_limit,
)
from millrace.extras.conformance.learner import Learner
from millrace.extras.conformance.script import Broken, Heard, Script, Skipped, Wait, brief
from millrace.extras.conformance.watch import resets_too_early
from millrace.protocol.arrays import Array
from millrace.protocol.bounds import MAX_LINE
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.envs.spaces import leaves_with_own_dtype, make_flatten
from millrace.protocol.messages import (
    Call,
    Drain,
    Failure,
    Goodbye,
    LaneIncarnation,
    Release,
    Reset,
    Returned,
    Step,
    Stepped,
    Weights,
)
from millrace.protocol.rules import Rule
from millrace.protocol.specs import StepSpec
from millrace.protocol.wire.codec import encode
from millrace.protocol.wire.plain_values import pack, unpack

WALK_STEPS = 300  # an episode should end within this many random steps
APART_STEPS = 8  # after this many steps, copies with different actions observe different things
LANES = 2


Mode = Literal["NextStep", "SameStep", "Disabled"]


def step_spec(learner: Learner, env: DescribedEnv, mode: Mode) -> StepSpec:
    """The specification of a session in which the client steps its copies on order."""
    N = learner.settings.copies
    return StepSpec(
        envs=(learner.settings.env,),
        copies=(0,) * (N * LANES),
        lanes=(N,) * LANES,
        observation=leaves_with_own_dtype(env.observation_space),
        action=leaves_with_own_dtype(env.action_space),
        autoreset=mode,
        heartbeat_s=learner.settings.heartbeat_s,
        learner_timeout_s=30.0,
    )


class Stepping:
    """A session of the environment profile. It makes and sends the orders that checks need."""

    def __init__(self, learner: Learner, env: DescribedEnv, mode: Mode = "NextStep") -> None:
        self.learner = learner
        self.env = env
        self.spec = step_spec(learner, env, mode)
        self.space: Any = env.action_space
        self.space.seed(1)
        self.flatten = make_flatten(env.action_space)

    def reset(
        self,
        lane: int = 0,
        incarnation: int = 0,
        copies: Sequence[int] | None = None,
        seed: int | None = 7,
        options: object = None,
    ) -> Reset:
        """A Reset of these copies (by default, of all copies), each with the seed `seed` plus the copy's number."""
        copies = range(self.spec.lanes[lane]) if copies is None else copies
        seeds = tuple(None if seed is None else seed + copy for copy in copies)
        packed = np.frombuffer(pack(options), np.uint8)
        return Reset(self.learner.session, next(self.learner.tickets), lane, incarnation, tuple(copies), seeds, packed)

    def step(self, lane: int = 0, incarnation: int = 0, actions: tuple[Array, ...] | None = None) -> Step:
        """A Step with these actions, by default random ones."""
        chosen = self.random_actions(self.spec.lanes[lane]) if actions is None else actions
        return Step(self.learner.session, next(self.learner.tickets), lane, incarnation, chosen)

    def random_actions(self, N: int) -> tuple[Array, ...]:
        """Random actions for N copies, as an array for each leaf of the action space."""
        each = [self.flatten(self.space.sample()) for _ in range(N)]
        return tuple(
            np.stack([np.asarray(values, leaf.dtype) for values in of_leaf])
            for leaf, of_leaf in zip(self.spec.action, zip(*each, strict=True), strict=True)
        )

    def do(self, order: Reset | Step) -> Script[Stepped]:
        """Send an order and wait for its answer."""
        self.learner.send(order)
        return (yield from self.answer(order))

    def walk(self, actions: Sequence[tuple[Array, ...]]) -> Script[list[Stepped]]:
        """Step lane 0 with these actions, one after the other. Returns the answers."""
        rows: list[Stepped] = []
        for each in actions:
            row = yield from self.do(self.step(actions=each))
            rows.append(row)
        return rows

    def answer(self, order: Reset | Step) -> Script[Stepped]:
        """Wait for the answer to an order that was sent."""
        text = f"Stepped for the {type(order).__name__} with ticket {order.ticket} of lane {order.lane}"
        return (yield from self.learner.expect(Stepped, Rule.ORDER_ANSWERED, text, ticket=order.ticket))


def stepping(learner: Learner, *lanes: int, mode: Mode = "NextStep") -> Script[Stepping]:
    """Begin a new session of the environment profile, and reset these lanes."""
    env = yield from described(learner)
    yield from learner.joining()
    steps = Stepping(learner, env, mode)
    learner.welcome(steps.spec)
    for lane in lanes:
        yield from steps.do(steps.reset(lane))
    return steps


def begins_in_its_session(learner: Learner) -> Script[None]:
    """Let the client wait for the vector environment, then begin it in the same session."""
    env = yield from described(learner)
    steps = Stepping(learner, env)
    yield from begins(learner, steps.spec)
    yield from steps.do(steps.reset())
    yield from steps.do(steps.step())


def answers_reset_and_step(learner: Learner) -> Script[None]:
    """Send the first orders of a lane."""
    steps = yield from stepping(learner)
    first = yield from steps.do(steps.reset())
    if first.reward.any() or first.terminated.any() or first.truncated.any():
        raise Broken(Rule.AFTER_RESET, "reward 0 and neither flag in the answer to a Reset of all copies", brief(first))
    for _ in range(5):
        yield from steps.do(steps.step())


def says_nothing_without_an_order(learner: Learner) -> Script[None]:
    """Send no order, and expect no Stepped."""
    yield from stepping(learner)
    yield from learner.quiet(Stepped, Rule.ORDER_ONLY, "nothing before the first order of the session", for_s=1.0)


def ends_episodes(learner: Learner) -> Script[None]:
    """Step with random actions, and check the ends of episodes and the resets that follow them."""
    steps = yield from stepping(learner)
    longest = steps.env.max_episode_steps
    before = yield from steps.do(steps.reset())
    length = np.zeros(steps.spec.lanes[0], int)
    ends = 0
    around: list[tuple[bytes, bytes]] = []  # pairs: last observation of an episode, first observation of the next
    for _ in range(WALK_STEPS):
        row = yield from steps.do(steps.step())
        ended = before.terminated | before.truncated
        for n in np.flatnonzero(ended):
            if row.reward[n] or row.terminated[n] or row.truncated[n]:
                raise Broken(
                    Rule.NEXT_STEP,
                    f"reward 0 and neither flag in copy {n}, in the step after the end of its episode",
                    f"reward {row.reward[n]:g}, terminated {row.terminated[n]}, truncated {row.truncated[n]}",
                )
            if before.terminated[n]:
                around.append((_of_copy(before, int(n)), _of_copy(row, int(n))))
        length = np.where(ended, 0, length + 1)
        _within(longest, length, row)
        ends += int((row.terminated | row.truncated).sum())
        before = row
        if ends >= 6:
            break
    if not ends:
        raise Skipped(f"no episode ended in {WALK_STEPS} steps")
    if resets_too_early(around):
        raise Broken(
            Rule.NEXT_STEP,
            "the last observation of an episode in the step that ends it, and the first one of the next in the step after",
            f"the same observation in both, at each of {len(around)} ends",
        )


def resets_otherwise(learner: Learner, mode: Mode) -> Script[None]:
    """Use the same seeds and actions with autoreset mode NextStep and then with `mode`, until an episode has ended.

    For comparison, NextStep shows both the last observation of that episode and the first one of the next.
    """
    steps = yield from stepping(learner)
    row = yield from steps.do(steps.reset())
    actions = list[tuple[Array, ...]]()
    while not (ended := row.terminated | row.truncated).any():
        if len(actions) > WALK_STEPS:
            raise Skipped(f"no episode ended in {WALK_STEPS} steps")
        actions.append(steps.random_actions(steps.spec.lanes[0]))
        row = yield from steps.do(steps.step(actions=actions[-1]))
    n = int(np.argmax(ended))
    last = row
    first = yield from steps.do(steps.step(actions=actions[-1]))
    steps = yield from stepping(learner, mode=mode)
    order = steps.reset()
    learner.send(order)
    yield from learner.takes_part(Stepped, Rule.ORDER_ANSWERED, f"Stepped for ticket {order.ticket}")
    *_, row = yield from steps.walk(actions)
    rule, resets = (Rule.SAME_STEP, True) if mode == "SameStep" else (Rule.DISABLED, False)
    if _numbers_of_copy(row, n) != _numbers_of_copy(last, n):
        raise Broken(rule, f"the reward and flags of copy {n} at the end of its episode, as with NextStep", "others")
    if _of_copy(row, n) != _of_copy(first if resets else last, n):
        which = "first observation of the next" if resets else "last observation of its"
        raise Broken(rule, f"the {which} episode in the step that ends that of copy {n}, as with NextStep", "another")
    if resets:
        info = dict(unpack(row.infos.tobytes(), row.reward.size) if row.infos.size else ()).get(n, {})
        leaves = make_flatten(steps.env.observation_space)(info["final_obs"]) if "final_obs" in info else ()
        if b"".join(np.asarray(leaf).tobytes() for leaf in leaves) != _of_copy(last, n) or "final_info" not in info:
            expected = f"final_obs, the last observation of the episode, and final_info in the info of copy {n}"
            raise Broken(rule, expected, "another observation" if leaves else f"{sorted(info)}")
        return
    learner.send(steps.step(actions=actions[-1]))
    answer = yield from learner.expect((Stepped, Failure), rule, "Stepped for a Step after the end of an episode")
    if isinstance(answer, Failure):
        yield from learner.left(Rule.STAYS, "Failure", (1,))
        raise Skipped("its environment cannot be stepped after an end")
    assert isinstance(answer, Stepped)
    if _of_copy(answer, n) == _of_copy(first, n) != _of_copy(last, n):
        raise Broken(rule, f"copy {n}, whose episode has ended, to be stepped", "the first observation of another episode")


def _numbers_of_copy(row: Stepped, n: int) -> tuple[float, bool, bool]:
    return float(row.reward[n]), bool(row.terminated[n]), bool(row.truncated[n])


def resets_with_options(learner: Learner) -> Script[None]:
    """Pass bounds of the first state as reset options: first the same for all copies, then different ones for each copy."""
    env = yield from described(learner)
    if not is_gymnasium_pole(env):
        raise Skipped("the environment is not gymnasium's CartPole")
    steps = yield from stepping(learner)
    for options in (
        {"low": 0.03, "high": 0.04},
        [{"low": n / 50, "high": n / 50 + 0.01} for n in range(steps.spec.lanes[0])],
    ):
        row = yield from steps.do(steps.reset(options=options))
        for n, state in enumerate(row.obs[0]):
            bounds = options[n] if isinstance(options, list) else options
            if not (bounds["low"] - 1e-6 <= state.min() and state.max() <= bounds["high"] + 1e-6):
                expected = f"a first state of copy {n} between {bounds['low']:g} and {bounds['high']:g} (options)"
                raise Broken(Rule.OPTIONS, expected, f"{state.round(4).tolist()}")


def _of_copy(row: Stepped, n: int) -> bytes:
    return b"".join(leaf[n].tobytes() for leaf in row.obs)


def _within(longest: int | None, length: Array, row: Stepped) -> None:
    """Raise `Broken` if an episode has reached the time limit without ending."""
    if longest is None:
        return
    at_limit = (length >= longest) & ~(row.terminated | row.truncated)
    if at_limit.any():
        n = int(np.argmax(at_limit))
        raise Broken(
            Rule.TRUNCATED,
            f"the end of the episode of copy {n} at {longest} steps, the longest_episode that the client described",
            f"no end after {int(length[n])} steps",
        )


def truncates_at_the_limit(learner: Learner) -> Script[None]:
    """Step until an episode reaches the time limit."""
    longest = yield from time_limit(learner)
    steps = yield from stepping(learner)
    act = controller(steps)
    row = yield from steps.do(steps.reset())
    length = np.zeros(steps.spec.lanes[0], int)
    for _ in range(3 * longest):
        before = row
        row = yield from steps.do(steps.step(actions=act(row)))
        length = np.where(before.terminated | before.truncated, 0, length + 1)
        _within(longest, length, row)
        early = row.truncated & ~row.terminated & (length < longest) & (length > 0)
        if early.any():
            n = int(np.argmax(early))
            raise Broken(Rule.TRUNCATED, f"truncated at {longest} steps, or terminated", f"truncated at {int(length[n])}")
        at = (length == longest) & row.truncated
        if at.any():
            return
    raise Skipped("no episode reached the time limit")


def controller(steps: Stepping) -> Callable[[Stepped], tuple[Array, ...]]:
    """A function that chooses actions for long episodes.

    It balances the pole if the spaces are those of CartPole, Box(4) and Discrete(2). Otherwise, actions are random.
    """
    observation, *more = steps.spec.observation
    action, *others = steps.spec.action
    is_pole = not more and not others and observation.shape == (4,) and action.kind == "discrete" and action.sizes == (2,)
    if not is_pole:
        return lambda row: steps.random_actions(len(row.reward))
    return lambda row: (
        (row.obs[0] @ np.array(POLE_GAINS) > 0).astype(action.dtype) + np.asarray(action.start or 0, action.dtype),
    )


def begins_the_same_episode_for_a_seed(learner: Learner) -> Script[None]:
    """Reset twice with the same seeds."""
    steps = yield from stepping(learner)
    one = yield from steps.do(steps.reset(seed=11))
    yield from steps.do(steps.step())
    two = yield from steps.do(steps.reset(seed=11))
    if not _same(one, two):
        raise Broken(Rule.SEEDED, "the same first observations for the same seeds", "others")


def _same(one: Stepped, other: Stepped) -> bool:
    return all(a.tobytes() == b.tobytes() for a, b in zip(one.obs, other.obs, strict=True))


def keeps_copies_apart(learner: Learner) -> Script[None]:
    """Give all copies the same seed and actions (plan 0). Then give all of them another seed and other actions (plan 1).
    Then give half of them plan 0 and the others plan 1. A copy must observe the same whenever it has the same plan.
    """
    steps = yield from stepping(learner)
    N = steps.spec.lanes[0]
    if N < 2:
        raise Skipped("the lanes have one copy each (--copies)")
    seeds = (21, 22)
    plans = [[steps.random_actions(1) for _ in range(APART_STEPS)] for _ in seeds]

    def play(of_copy: Sequence[int]) -> Script[list[Stepped]]:
        """The answers if copy n has the seed and the actions of plan `of_copy[n]`."""
        first = yield from steps.do(replace(steps.reset(), seeds=tuple(seeds[plan] for plan in of_copy)))
        rest = yield from steps.walk(
            [
                tuple(np.concatenate(leaves) for leaves in zip(*(plans[plan][t] for plan in of_copy), strict=True))
                for t in range(APART_STEPS)
            ]
        )
        return [first, *rest]

    first = yield from play([0] * N)
    second = yield from play([1] * N)
    alone = (first, second)
    mixed = yield from play([n % 2 for n in range(N)])
    for t, row in enumerate(mixed):
        for n in range(N):
            if _of_copy(row, n) != _of_copy(alone[n % 2][t], n):
                as_before = f"what all copies observed when they had its seed {seeds[n % 2]} and its actions"
                expected = f"copy {n} to observe after {t} steps {as_before}"
                raise Broken(Rule.OWN_ROW if t else Rule.SEEDED, expected, "another observation")


def executes_an_order_once(learner: Learner) -> Script[None]:
    """Send orders again, as if their answers had been lost. The client must execute each order only once."""
    steps = yield from stepping(learner)
    actions = [steps.random_actions(steps.spec.lanes[0]) for _ in range(3)]
    yield from steps.do(steps.reset(seed=3))
    plain = yield from steps.walk(actions)
    order = steps.reset(seed=3)
    yield from steps.do(order)
    yield from _again(learner, order)
    for each, expected in zip(actions, plain, strict=True):
        again = steps.step(actions=each)
        stepped = yield from steps.do(again)
        if not _same(stepped, expected):
            raise Broken(
                Rule.ORDER_ONCE,
                "the same observations, for the same seed and actions, as without repeated orders",
                "others",
            )
        for _ in range(2):
            yield from _again(learner, again)


def _again(learner: Learner, order: Reset | Step) -> Script[None]:
    """Repeat an order, and wait for the same answer again."""
    learner.send(order)
    yield from learner.expect(Stepped, Rule.ORDER_ONCE, f"the answer to ticket {order.ticket} again", ticket=order.ticket)


def ignores_an_old_order(learner: Learner) -> Script[None]:
    """Send a late copy of an order after newer orders."""
    steps = yield from stepping(learner)
    first = steps.reset()
    yield from steps.do(first)
    yield from steps.do(steps.step())
    learner.send(first)
    yield from learner.quiet(Stepped, Rule.ORDER_OLD, f"no answer to ticket {first.ticket} after a newer one")
    yield from steps.do(steps.step())


def ignores_another_session(learner: Learner) -> Script[None]:
    """Send orders of the previous session. Heartbeats must still count that session's steps."""
    old = yield from stepping(learner, 0)
    before = learner.session
    yield from old.do(old.step())
    for _ in range(4):  # some Heartbeats may have been on their way before the Step
        heartbeat = yield from heartbeats(learner, 1)
        if heartbeat.steps:
            break
    else:
        raise Broken(Rule.HEARTBEAT_STEPS, "steps above 0 after a Step", "0")
    steps = yield from stepping(learner, 0)
    learner.send(replace(steps.step(), session=before))
    yield from learner.quiet(Stepped, Rule.OTHER_SESSION, "no answer to an order of the session before")
    yield from steps.do(steps.step())
    yield from heartbeats(learner, 1)


def serves_two_lanes(learner: Learner) -> Script[None]:
    """Send orders for two lanes before waiting for the answers."""
    steps = yield from stepping(learner)
    for orders in (
        [steps.reset(0), steps.reset(1)],
        [steps.step(0), steps.step(1)],
        [steps.step(1), steps.step(0)],
    ):
        for order in orders:
            learner.send(order)
        for order in orders:
            if order.ticket not in learner.watch.answers:
                yield from steps.answer(order)


def starts_a_lane_again(learner: Learner) -> Script[None]:
    """Send orders of a higher incarnation, then an order of a lower one."""
    steps = yield from stepping(learner, 0)
    yield from steps.do(steps.step())
    yield from steps.do(steps.reset(incarnation=2))
    yield from steps.do(steps.step(incarnation=2))
    learner.send(steps.step(incarnation=1))
    yield from learner.quiet(Stepped, Rule.INCARNATION, "no answer to an order of incarnation 1 after one of 2")
    yield from steps.do(steps.step(incarnation=2))


def resets_some_copies(learner: Learner) -> Script[None]:
    """Send a Reset that lists only one copy."""
    steps = yield from stepping(learner)
    if steps.spec.lanes[0] < 2:
        raise Skipped("the lanes have one copy each (--copies)")
    yield from steps.do(steps.reset(seed=5))
    before = yield from steps.do(steps.step())
    after = yield from steps.do(steps.reset(copies=(0,), seed=5))
    for one, other in zip(before.obs, after.obs, strict=True):
        if one[1:].tobytes() != other[1:].tobytes():
            raise Broken(Rule.RESET_SOME, "the observations of copies that the Reset does not list as they were", "others")
    if after.reward[0] or after.terminated[0] or after.truncated[0]:
        raise Broken(Rule.AFTER_RESET, "reward 0 and neither flag in copy 0", f"reward {after.reward[0]:g}")


def answers_calls(learner: Learner) -> Script[None]:
    """Send a Call for an attribute that every gymnasium environment has, and for two that none has."""
    steps = yield from stepping(learner, 0)
    for name in ("render_mode", "no_such_attribute_anywhere", "…" * MAX_LINE):
        given = np.frombuffer(pack(((), {})), np.uint8)
        call = Call(learner.session, next(learner.tickets), 0, 0, (0,), name, False, given)
        learner.send(call)
        returned = yield from learner.expect(
            Returned, Rule.RETURNED, f"Returned for ticket {call.ticket}", ticket=call.ticket
        )
        if returned.error:
            continue
        results = unpack(returned.results.tobytes())
        if name != "render_mode" or not isinstance(results, list) or len(results) != 1:
            raise Broken(Rule.RETURNED, "one result for the one copy, or an error", f"{results!r}"[:100])
    yield from steps.do(steps.step())


def beats_while_it_steps(learner: Learner) -> Script[None]:
    """Send orders without a pause. Meanwhile, the watch checks that heartbeats arrive."""
    steps = yield from stepping(learner, 0)
    until_s = learner.now + 2 * 1.5 + 8 * learner.settings.heartbeat_s
    while learner.now < until_s:
        yield from steps.do(steps.step())


def lists_its_tickets(learner: Learner) -> Script[None]:
    """Wait for Heartbeats after all orders were answered. They must list no ticket."""
    yield from stepping(learner, 0)
    heartbeat = yield from heartbeats(learner, 3)
    if heartbeat.tickets:
        raise Broken(Rule.HEARTBEAT_TICKETS, "no tickets while no order is open", f"{list(heartbeat.tickets)}")


def releases_a_lane(learner: Learner) -> Script[None]:
    """Release a lane, as if it were moving to another worker, and give it back later."""
    steps = yield from stepping(learner, 0, 1)
    learner.send(steps.step(0))  # the client may or may not answer it
    learner.send(Release(learner.session, (LaneIncarnation(0, 0),)))
    learner.answers_heartbeats = False  # a reply would close the lane too
    yield from _has_no_copies(steps, Rule.RELEASE)
    learner.answers_heartbeats = True
    learner.send(Release(learner.session, (LaneIncarnation(0, 0),)))
    yield Wait(0.3)
    heartbeat = yield from heartbeats(learner, 3)
    if heartbeat.tickets:
        raise Broken(Rule.RELEASE, "no tickets of the released lane", f"{list(heartbeat.tickets)}")
    yield from steps.do(steps.step(1))
    yield from steps.do(steps.reset(0, incarnation=1))
    yield from steps.do(steps.step(0, incarnation=1))


def forgets_unlisted_lanes(learner: Learner) -> Script[None]:
    """Send no Release, as if it had been lost, and don't list the lane in the next HeartbeatReply."""
    steps = yield from stepping(learner, 0, 1)
    learner.watch.sent(Release(learner.session, (LaneIncarnation(0, 0),)))  # only recorded, not sent, as if it had been lost
    yield from heartbeats(learner, 3)
    yield from _has_no_copies(steps, Rule.UNLISTED)
    yield from steps.do(steps.step(1))
    yield from steps.do(steps.reset(0, incarnation=1))


def _has_no_copies(steps: Stepping, rule: Rule) -> Script[None]:
    """Check that lane 0, whose copies had episodes, was closed. A Reset of one copy must be ignored or make new copies."""
    order = steps.reset(copies=(0,))
    steps.learner.send(order)
    yield Wait(0.5, lambda event: isinstance(event, Heard) and getattr(event.message, "ticket", 0) == order.ticket)
    answer = steps.learner.watch.answers.get(order.ticket)
    if isinstance(answer, Stepped) and any(leaf[1:].any() for leaf in answer.obs):
        expected = "new copies in a lane that was closed: zeros in the rows of those without an episode"
        raise Broken(rule, expected, "observations of the copies before")


def answers_after_a_reset_connection(learner: Learner) -> Script[None]:
    """Cut the connection while an order is unanswered."""
    steps = yield from stepping(learner, 0)
    order = steps.step()
    learner.send(order)
    yield from over_a_new_connection(learner, Stepped)
    if order.ticket not in learner.watch.answers:
        learner.send(order)
        yield from steps.answer(order)
    yield from steps.do(steps.step())


def ignores_what_it_cannot_read(learner: Learner) -> Script[None]:
    """Send an unknown type, an extra field, a missing frame, bytes that aren't msgpack, and so on."""
    steps = yield from stepping(learner, 0)
    order = steps.step()
    head = msgpack.unpackb(bytes(encode(order)[0]))
    arrays = list(encode(order)[1:])
    learner.send_unreadable(
        order.ticket,
        [msgpack.packb([*head, "one field too many"]), *arrays],
        [msgpack.packb(head[:-1])],
        [msgpack.packb(head)],
        [msgpack.packb(head), *arrays, b"one frame too many"],
        [msgpack.packb(head) + b"\0", *arrays],
        [msgpack.packb(["NoSuchMessage", learner.session])],
        [msgpack.packb({"type": "Refuse"})],
        [b"\xc1"],
        [b""],
    )
    yield from learner.quiet(Stepped, Rule.IGNORE_UNREADABLE, "no answer to what cannot be read")
    yield from steps.do(steps.step())


def reads_long_messages(learner: Learner) -> Script[None]:
    """Send a Release with so many lanes that its head is almost as long as allowed, and Weights with a frame of 8 MiB."""
    steps = yield from stepping(learner, 0)
    learner.send(Release(learner.session, tuple(LaneIncarnation(1000 + lane, 0) for lane in range(60_000))))
    learner.send(Weights(1, np.zeros(1 << 21, np.float32), np.zeros(0, np.float32)))
    yield from steps.do(steps.step())


def takes_a_late_welcome(learner: Learner) -> Script[None]:
    """Send a copy of the Welcome during an episode."""
    steps = yield from stepping(learner)
    yield from steps.do(steps.reset(seed=9))
    expected = [steps.random_actions(steps.spec.lanes[0]) for _ in range(2)]
    rows = yield from steps.walk(expected)
    yield from steps.do(steps.reset(seed=9))
    yield from steps.do(steps.step(actions=expected[0]))
    learner.send(learner.watch.welcome)
    stepped = yield from steps.do(steps.step(actions=expected[1]))
    if not _same(stepped, rows[1]):
        raise Broken(Rule.REPEATED_WELCOME, "the episode to go on after a repeated Welcome", "another observation")


def drains_while_it_steps(learner: Learner) -> Script[None]:
    """Send Drain right after an order."""
    steps = yield from stepping(learner, 0)
    order = steps.step()
    learner.send(order)
    learner.send(Drain("the run is over"))
    goodbye = yield from learner.expect(Goodbye, Rule.DRAIN, "Goodbye after Drain")
    listed = order.ticket in goodbye.tickets
    if listed == (order.ticket in learner.watch.answers):
        raise Broken(
            Rule.DRAIN,
            f"ticket {order.ticket} either answered before Goodbye or listed in it",
            "both" if listed else "neither",
        )
    yield from learner.left(Rule.DRAIN, "Drain and Goodbye")
