"""leaderboard.md: the returns of each environment, of millrace's runs beside those that others have published."""

from __future__ import annotations

from benchmarks.markdown_tables import table
from benchmarks.scores import PublishedScore, Score, read_published, read_scores, return_text

HEAD = """# Leaderboard

Look here to see what an algorithm reaches in an environment, and after how many env steps. Rows of millrace are bold: means
over seeds of the final policies, each over 100 greedy episodes. [Results](results.md) has each seed, and the command that
repeats it. The other rows are what their projects have published, with other settings and other evaluations; the last column
says what is known of them. There, v2, v3 and v4 are older versions of the environment.

"""


def page() -> str:
    """The page."""
    scores, published = read_scores(), read_published()
    parts = [HEAD]
    for env in dict.fromkeys(score.env for score in scores):
        rows = [((-round(score.mean(), 2), score.env_steps), _row(score)) for score in scores if score.env == env]
        rows += [((-score.returns, score.env_steps), _published_row(score)) for score in published if score.env == env]
        ranked = [row for _, row in sorted(rows, key=lambda one: one[0])]  # of equal returns, that of fewer env steps first
        parts.append(f"## {env}\n\n{table(('return', 'algorithm', 'env steps', 'system', 'how'), ranked)}\n")
    return "".join(parts)


def _row(score: Score) -> tuple[str, ...]:
    seeds = f"{len(score.final)} seeds" if len(score.final) > 1 else "one seed"
    values = (return_text(score.mean()), score.algo, f"{score.env_steps:,}", "millrace")
    return (*(f"**{value}**" for value in values), ", ".join(filter(None, (seeds, score.note))))


def _published_row(score: PublishedScore) -> tuple[str, ...]:
    return return_text(score.returns), score.algo, f"{score.env_steps:,}", score.system, score.how
