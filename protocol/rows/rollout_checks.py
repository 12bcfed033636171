"""Checks a rollout: its shapes and dtypes must be those of the run, its values in the run's spaces, and its rows must obey
the row law. Pure.

Rule: before sending a rollout, a worker checks everything that its environment can get wrong:
`workers/copies/value_checks.py` checks values, and `protocol/envs/seats.py` checks the law of seats. The learner checks
everything again, because a worker may be hostile.
"""

from __future__ import annotations

import math

import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.bounds import LARGEST
from millrace.protocol.errors import BadRollout
from millrace.protocol.policy.masks import no_choice, not_allowed
from millrace.protocol.rollout import Episode, Rollout, memory_bytes, saved_bytes
from millrace.protocol.rows.array_checks import Axes, Expected, place_of, wrong_arrays, wrong_observation
from millrace.protocol.specs import ActionSpec, RunSpec

LARGEST_REWARD = float(np.finfo(np.float32).max) * (1 + 2**-25)
"""The largest number that is still finite when it is rounded to float32. Returns are sums of rewards before
this rounding.
"""


def validate(rollout: Rollout, run: RunSpec, most_steps: int = LARGEST) -> None:
    """Check a rollout. Raises `BadRollout`, with a one-line message, if it does not fit the run or breaks the row format.

    `most_steps` is the largest possible length of an episode.
    """
    T = run.rollout_steps
    N = run.sent_columns
    action = run.policy.action
    axes = run.sent_axes
    expected = [
        Expected("action", rollout.action, (T, N, *action.shape), action.stored_dtype, action),
        Expected("log_prob", rollout.log_prob, (T, N), "float32"),
        Expected("reward", rollout.reward, (T, N), "float32"),
        Expected("terminated", rollout.terminated, (T, N), "bool"),
        Expected("truncated", rollout.truncated, (T, N), "bool"),
        Expected("valid", rollout.valid, (T, N), "bool"),
        Expected("state", rollout.state[None], (1, N, run.policy.state_size), "float32"),  # so that errors say "at step 0"
    ]
    if (rollout.mask is not None) != run.masked:
        raise BadRollout(f"mask: expected {'one' if run.masked else 'none'}")
    if rollout.mask is not None:
        expected.append(Expected("mask", rollout.mask, (T + 1, N, action.choices), "bool"))
    if (rollout.resets is not None) != bool(run.seats):
        raise BadRollout(f"resets: expected {'some' if run.seats else 'none'}")
    if rollout.resets is not None:
        expected.append(Expected("resets", rollout.resets, (T + 1, run.copies), "bool"))
    if len(rollout.extras) != len(run.extras):
        raise BadRollout(f"extras: expected {len(run.extras)} arrays, got {len(rollout.extras)}")
    for extra, array in zip(run.extras, rollout.extras, strict=True):
        expected.append(Expected(f"extra {extra.name}", array, (T, N, *extra.shape), extra.dtype))
    if why := wrong_observation(rollout.obs, run.policy.seen, (T + 1, N), axes) or wrong_arrays(expected, axes):
        raise BadRollout(why)
    if not 0 <= rollout.lane < run.lanes:
        raise BadRollout(f"lane: expected 0 to {run.lanes - 1}, got {rollout.lane}")
    if rollout.mask is not None:
        _check_mask(rollout.mask, rollout, action, axes)
    ended = rollout.terminated | rollout.truncated
    if rollout.resets is not None:
        _check_seats(rollout.valid, ended, rollout.resets, run)
        count = int(np.count_nonzero(rollout.resets[1:]))
    elif np.count_nonzero(rollout.valid[1:] == ended[:-1]):
        t, n = np.argwhere(rollout.valid[1:] == ended[:-1])[0]
        raise BadRollout(f"valid: expected {not ended[t, n]} at step {t + 1}, copy {n}, got {bool(rollout.valid[t + 1, n])}")
    else:
        count = int(np.count_nonzero(ended & rollout.valid))
    if len(rollout.episodes) != count:
        raise BadRollout(f"episodes: expected {count}, got {len(rollout.episodes)}")
    for episode in rollout.episodes:
        if why := wrong_episode(episode, run, most_steps):
            raise BadRollout(f"episode: {why}")
    begun = [each.copy for each in rollout.begun]
    if len(set(begun)) < len(begun) or max(begun, default=0) >= run.copies:
        raise BadRollout(f"begun: expected each of the copies 0 to {run.copies - 1} at most once, got {begun[:100]}")
    most_starts = LARGEST // 2 + rollout.ticket  # later starts must fit too, and each needs another ticket
    if (start := max((each.start for each in rollout.begun), default=0)) > most_starts:
        raise BadRollout(f"begun: expected starts up to {most_starts}, got {start}")
    if len(set(rollout.saved)) < len(rollout.saved) or max(rollout.saved, default=0) >= run.copies:
        raise BadRollout(f"saved: expected copies 0 to {run.copies - 1}, each at most once, got {rollout.saved[:100]}")
    most = memory_bytes(run) + saved_bytes(len(rollout.saved))
    if (size := sum(array.nbytes for array in rollout.memory)) > most:
        raise BadRollout(f"memory: expected at most {most} bytes, got {size}")


def _check_seats(valid: Array, ended: Array, resets: Array, run: RunSpec) -> None:
    """Raise `BadRollout` if the rows of seats break the row law. `valid` and `ended` are [T, N · A], `resets`
    is [T+1, N].
    """
    reset = np.repeat(resets, run.sent_seats, axis=1)  # [T+1, N·A]
    steps = np.arange(len(valid))[:, None]
    # The last valid row, the last end and the last reset up to each step.
    row, end, begin = (np.maximum.accumulate(np.where(flags, steps, -1)) for flags in (valid, ended, reset[:-1]))
    gone = np.zeros_like(reset)  # whether the seat has left this episode
    plays = np.zeros_like(reset)  # whether the seat has a row in this episode, and has not left
    gone[1:] = end > begin
    plays[1:] = row > end
    idle = plays[:-1] & ~valid if not run.takes_turns else np.zeros_like(valid)
    for wrong, expected in (
        (ended & ~valid, "valid: expected no end in a row that is not valid"),
        (valid & reset[:-1], "valid: expected none in a step that only resets the copy"),
        (valid & gone[:-1], "valid: expected none of a seat whose part of the episode has ended"),
        (plays & reset, "resets: expected none before the part of each seat has ended"),
        (reset[1:] & reset[:-1], "resets: expected none right before another"),
        (idle, "valid: expected no gap after a row that has not ended, because no agent waits for others"),
    ):
        if wrong.any():
            raise BadRollout(f"{expected}, got one at {place_of(np.argwhere(wrong)[0], run.sent_axes)}")


def _check_mask(mask: Array, rollout: Rollout, action: ActionSpec, axes: Axes) -> None:
    """Raise `BadRollout` if a mask allows no choice at all, or forbids the action that was chosen."""
    if (empty := no_choice(mask, action)).any():
        raise BadRollout(f"mask: expected an allowed choice at {place_of(np.argwhere(empty)[0], axes)}, got none")
    if (wrong := rollout.valid & not_allowed(rollout.action, mask[:-1], action)).any():
        t, n = np.argwhere(wrong)[0]
        got = rollout.action[t, n].tolist()
        raise BadRollout(f"action: expected one that the mask allows at {place_of((t, n), axes)}, got {got}")


def wrong_episode(episode: Episode, run: RunSpec, most_steps: int) -> str:
    """What is wrong with an episode; empty if it is possible in this run. An episode has at most `most_steps` steps."""
    whole = 0 < episode.length <= most_steps and 0 <= episode.seconds < math.inf
    if not (whole and abs(episode.reward) <= episode.length * run.seats_of_copy * LARGEST_REWARD):  # NaN is wrong too
        return f"expected a finite return of 1 to {most_steps} float32 rewards and a duration, got {episode}"
    return wrong_facts(episode, run)


def wrong_facts(episode: Episode, run: RunSpec) -> str:
    """What is wrong with the facts of an episode; empty if they are those of the run. A missing fact is NaN."""
    if len(episode.facts) != len(run.facts):
        return f"expected {len(run.facts)} facts, got {len(episode.facts)}"
    if any(map(math.isinf, episode.facts)):
        return f"expected finite facts, got {episode.facts}"
    if (episode.opponent is not None) != bool(run.teams):
        return f"expected {'an opponent' if run.teams else 'no opponent'}, got {episode.opponent}"
    if episode.opponent is not None:
        if episode.opponent < -len(run.scripted):
            return f"expected an opponent from {-len(run.scripted)}, got {episode.opponent}"
        teams = len(run.teams)
        if episode.facts[-1] not in {0.0, *(1 / sharing for sharing in range(1, teams + 1))}:
            shared = "1 or 1/2" if teams == 2 else f"1/n for n from 1 to {teams}"
            return f"expected the score 0, {shared}, got {episode.facts[-1]}"
    return ""
