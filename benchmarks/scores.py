"""Returns that millrace's runs have reached (scores.json) and returns that others have published (published_scores.toml).

The repository doesn't contain run folders, but only the numbers that the tables need from them. To add runs:
`python -m benchmarks.results RUN ...`
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec

from benchmarks.intervals import FEWEST, interval_of
from benchmarks.markdown_tables import table

SCORES, PUBLISHED = (Path(__file__).with_name(name) for name in ("scores.json", "published_scores.toml"))
EPISODES = 100
"""number of greedy episodes in each of millrace's scores"""


class Score(msgspec.Struct, kw_only=True, omit_defaults=True):
    """The returns of runs that differ only in their seeds."""

    env: str
    algo: str
    command: str
    """the command of each run, with S in place of the seed"""
    env_steps: int
    """env steps of the longest run"""
    final: dict[int, float]
    """mean return of the final policy, by seed"""
    best: dict[int, float] = {}
    """mean return, on other episodes, of the best policy of the run's own evaluations, by seed; empty without evaluations"""
    seconds: float | None = None
    """wall-clock seconds of the longest run, if they are meaningful"""
    versions: dict[str, str] = {}
    """versions of the packages that affect the results, if they are the same for all seeds"""
    note: str = ""
    """a remark about the row"""


class PublishedScore(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """A return that another project has published."""

    env: str
    """millrace's name for the environment with which it is compared"""
    algo: str
    system: str
    returns: float
    env_steps: int
    how: str = ""
    """what differs, such as the version of the environment, the number of runs, or the way of evaluating"""


def read_scores() -> list[Score]:
    """The scores of millrace, sorted by environment, algorithm and number of env steps."""
    return msgspec.json.decode(SCORES.read_bytes(), type=list[Score])


def write_scores(scores: Iterable[Score]) -> None:
    """Write millrace's scores."""
    ordered = sorted(scores, key=lambda score: (score.env, score.algo, score.env_steps, score.command))
    SCORES.write_bytes(b"[\n" + b",\n".join(map(msgspec.json.encode, ordered)) + b"\n]\n")


def read_published() -> list[PublishedScore]:
    """The scores that others have published."""
    return msgspec.convert(tomllib.loads(PUBLISHED.read_text())["score"], list[PublishedScore])


def merged(old: Score | None, new: Score) -> Score:
    """The runs in `new`, and the runs in `old` with other seeds."""
    if old is None:
        return new
    return msgspec.structs.replace(
        new,
        final=dict(sorted({**old.final, **new.final}.items())),
        best=dict(sorted({**old.best, **new.best}.items())),
        env_steps=max(old.env_steps, new.env_steps),
        seconds=max((each for each in (old.seconds, new.seconds) if each is not None), default=None),
        versions=new.versions if new.versions == old.versions else {},
        note=old.note,
    )


def return_text(value: float) -> str:
    """A return for a table, with at least three digits."""
    return f"{value:,.{2 if abs(value) < 10 else 1 if abs(value) < 100 else 0}f}"


def steps_text(env_steps: int) -> str:
    """A rounded number of env steps, such as 300k or 1M."""
    return f"{round(env_steps / 1e6, 1):g}M" if env_steps > 0.95e6 else f"{round(env_steps / 1e3)}k"


def seeds_text(returns: dict[int, float]) -> str:
    """The interquartile mean with its interval, if there are five seeds or more; otherwise each return.

    Seeds are named if they aren't 1 … N.
    """
    if not returns:
        return "–"
    first_seeds = sorted(returns) == list(range(1, len(returns) + 1))
    if first_seeds and len(returns) >= FEWEST:
        mean, low, high = map(return_text, interval_of(list(returns.values())))
        return f"**{mean}** [{low}, {high}], {len(returns)} seeds"
    text = ", ".join(return_text(value) for _, value in sorted(returns.items()))
    if first_seeds and len(returns) == 3:
        return text
    which = ", ".join(map(str, sorted(returns)))
    return f"{text} (seed {which} only)" if len(returns) == 1 else f"{text} (seeds {which})"


def returns_table(scores: Iterable[Score], published: Sequence[PublishedScore]) -> str:
    """The table of docs/explanation/results.md: millrace's returns, and published returns of the same algorithm."""
    head = ("environment", "algorithm", "env steps", "final policy", "best policy", "published (env steps)")
    rows = []
    for score in scores:
        others = [
            f"{other.system} {return_text(other.returns)} ({steps_text(other.env_steps)})"
            for other in published
            if (other.env, other.algo) == (score.env, score.algo)
        ]
        env = f"{score.env}, {score.note}" if score.note else score.env
        returns = seeds_text(score.final), seeds_text(score.best)
        rows.append((env, score.algo, steps_text(score.env_steps), *returns, ", ".join(others)))
    return table(head, rows)


def commands_table(scores: Iterable[Score]) -> str:
    """The table of benchmarks/README.md: the command of each score, and how long it took."""
    rows = [("–" if score.seconds is None else f"{score.seconds:.0f}", f"`{score.command}`") for score in scores]
    return table(("seconds", "command"), rows)
