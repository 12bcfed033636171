"""Connect Four against two programs, which are opponents for training and for measuring a policy's score.

The opponents are `benchmarks.connect_four:LookAhead` and `benchmarks.connect_four:AtRandom`. To print the scores of runs'
greedy policies in 200 games against each: `python -m benchmarks.connect_four RUN ...`
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from pettingzoo.classic import connect_four_v3

import millrace

ROWS = 6
COLUMNS = 7
GAMES = 200  # number of games against each program; the policy begins in every other game

Array = np.ndarray[Any, Any]


def lines_of_four() -> Array:
    """The cells of each line of four, [69, 4]. A cell has the number row · COLUMNS + column."""
    starts = [
        (r, c, down, right) for r in range(ROWS) for c in range(COLUMNS) for down, right in ((0, 1), (1, 0), (1, 1), (1, -1))
    ]
    lines = [[(r + k * down, c + k * right) for k in range(4)] for r, c, down, right in starts]
    return np.array(
        [[r * COLUMNS + c for r, c in line] for line in lines if all(r < ROWS and 0 <= c < COLUMNS for r, c in line)]
    )


LINES = lines_of_four()


class AtRandom:
    """An opponent that chooses any column that isn't full."""

    def act(
        self, obs: dict[str, Array], state: Array, rng: np.random.Generator, mask: Array
    ) -> tuple[Array, Array, dict[str, Any]]:
        boards = zip(obs["observation"], mask, strict=True)
        return np.array([self.column(board, np.flatnonzero(allowed), rng) for board, allowed in boards]), state, {}

    def column(self, board: Array, columns: Array, rng: np.random.Generator) -> int:
        """Choose one of these columns. `board`: [ROWS, COLUMNS, 2], the player's own pieces and the opponent's pieces."""
        return int(rng.choice(columns))


class LookAhead(AtRandom):
    """An opponent that prefers a column that wins at once, then one in which the other player would win at once."""

    def column(self, board: Array, columns: Array, rng: np.random.Generator) -> int:
        for pieces in np.moveaxis(board.astype(bool), -1, 0):
            for column in columns:
                after = pieces.copy()
                after[ROWS - 1 - int(board[:, column].sum()), column] = True
                if after.ravel()[LINES].all(1).any():
                    return int(column)
        return super().column(board, columns, rng)


def score(policy: Any, program: AtRandom) -> float:
    """The share of games that the policy wins if it acts greedily. A tie counts as half a win."""
    env = connect_four_v3.env()
    rng = np.random.default_rng(1)
    total = 0.0
    for game in range(GAMES):
        env.reset(seed=game)
        mine = env.agents[game % 2]
        for agent in env.agent_iter():
            observation, reward, terminated, truncated, _ = env.last()
            if terminated or truncated:
                total += (reward + 1) / 2 * (agent == mine)
                env.step(None)
            elif agent == mine:
                env.step(policy(observation))
            else:
                allowed = np.flatnonzero(observation["action_mask"])
                env.step(program.column(observation["observation"], allowed, rng))
    return total / GAMES


if __name__ == "__main__":
    for run in sys.argv[1:]:
        saved = millrace.load(run)
        found = {type(program).__name__: score(saved, program) for program in (AtRandom(), LookAhead())}
        print(Path(run).name, *(f"{name} {value:.3f}" for name, value in found.items()))
