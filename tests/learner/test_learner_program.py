"""`python -m learner`: what its log says. tests/system runs the whole program."""

from __future__ import annotations

from learner.__main__ import line_of
from learner.run_folder.progress import Progress


def test_the_log_says_how_far_a_run_is() -> None:
    progress = Progress(env_steps=1_000, total_steps=20_000, workers_alive=2)
    assert line_of(progress) == "1,000 of 20,000 env steps, return none yet, 2 workers"
    later = Progress(env_steps=1_000, total_steps=20_000, workers_alive=2, return_mean=21.838383838383837)
    assert line_of(later) == "1,000 of 20,000 env steps, return 21.8, 2 workers"
