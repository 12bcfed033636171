"""The sentences about a run: which part is the slowest, also where only one side can wait, and what went wrong."""

import pytest

from millrace.learner.run_folder.sentences import (
    bottleneck,
    percent,
    return_in_words,
    steps_in_words,
    went_wrong,
    workers_in_words,
)
from millrace.protocol.progress import RunProgress

IN_TURN = "Updates are the slowest part: the learner updates for 80% of the time, and workers wait for 80%."


@pytest.mark.parametrize(
    ("learner", "worker", "said"),
    [
        ({}, {}, ""),
        ({"wait": 3.0}, {}, ""),  # no heartbeat has come
        ({"wait": -1.0, "evaluate": 1.0}, {}, ""),  # a learner of somebody else says anything
        ({"wait": 2.0, "update": 8.0}, {"act": 1.0, "step": 1.0, "wait": 8.0}, IN_TURN),
        (
            {"wait": 8.0, "update": 2.0}, {"act": 4.0, "step": 4.0, "wait": 2.0},
            "Collecting is the slowest part: the learner waits for 80% of the time, and workers for 20%.",
        ),
        (
            {"wait": 5.0, "update": 5.0}, {"act": 2.0, "step": 3.0, "wait": 5.0},
            "No part is the slowest: the learner waits for 50% of the time, and workers for 50%.",
        ),
        (  # half of the workers are done at once
            {"wait": 8.0, "update": 2.0}, {"step": 4.0, "wait": 6.0},
            "Both sides wait, for slower workers or for messages: the learner for 80% of the time, and workers for 60%.",
        ),
        (  # one worker, and many short rollouts: the time of their messages counts as waiting on both sides
            {"wait": 2.0, "update": 7.0, "other": 1.0}, {"step": 1.0, "wait": 9.0},
            "Updates are the slowest part: the learner updates for 70% of the time, and workers wait for 90%.",
        ),
        (  # at the same time: the learner updates for most of it, and yet it waits for the workers, which never wait
            {"wait": 4.0, "update": 6.0}, {"act": 2.0, "step": 8.0},
            "Collecting is the slowest part: the learner waits for 40% of the time, and workers for 0%.",
        ),
        (
            {"update": 9.0, "other": 1.0}, {"act": 3.0, "step": 3.0, "wait": 4.0},
            "Updates are the slowest part: the learner updates for 90% of the time, and workers wait for 40%.",
        ),
        (
            {"wait": 1.0, "update": 2.0, "other": 7.0}, {"step": 1.0, "wait": 9.0},
            "Callbacks, checkpoints and metrics are the slowest part: the learner is busy with them for 70% of the time, "
            "and workers wait for 90%.",
        ),
        (
            {"wait": 2.0, "update": 2.0, "evaluate": 6.0}, {"step": 1.0, "wait": 1.0, "evaluate": 8.0},
            "Evaluations are the slowest part: they take 60% of the time.",
        ),
        ({"wait": 2.0, "update": 8.0, "evaluate": 9.0}, {"open": 9.0, "step": 2.0, "wait": 8.0, "evaluate": 9.0}, IN_TURN),
    ],
)  # fmt: skip
def test_the_side_that_waits_less_is_the_slowest_part(
    learner: dict[str, float], worker: dict[str, float], said: str
) -> None:
    stages = {f"learner_{name}": s for name, s in learner.items()} | {f"worker_{name}": s for name, s in worker.items()}
    assert bottleneck(RunProgress(stages=stages)) == said


def test_a_long_wait_is_said_first() -> None:
    stages = {"learner_wait": 2.0, "learner_update": 8.0, "worker_wait": 8.0}
    waiting = RunProgress(waiting="waiting 3 s for lane 1", stages=stages)
    assert bottleneck(waiting) == "The learner has been waiting 3 s for lane 1."
    waited = RunProgress(waiting="waited 3 s for rollouts", stages=stages)
    assert bottleneck(waited) == "The learner waited 3 s for rollouts."


def test_a_run_that_has_ended_waits_for_nobody() -> None:
    ended = RunProgress(waiting="waiting 3 s for lane 1", stop_reason="all steps done")
    assert bottleneck(ended) == ""


def test_numbers_have_the_same_words_everywhere() -> None:
    progress = RunProgress(env_steps=9_000, collected=999, total_steps=10_000, workers_alive=1, workers_expected=2)
    assert steps_in_words(progress) == "9,999 of 10,000"
    assert percent(progress) == "99%", "it is not done"
    assert workers_in_words(progress) == "1 of 2"
    beyond = RunProgress(env_steps=9_900, collected=151, total_steps=10_000)
    assert steps_in_words(beyond) == "10,000 of 10,000", "no update uses more"
    without_end = RunProgress(env_steps=9_000, workers_alive=3)
    assert (steps_in_words(without_end), percent(without_end), workers_in_words(without_end)) == ("9,000", "0%", "3")
    assert (return_in_words(None), return_in_words(-1_234.56)) == ("none yet", "-1,234.6")
    assert return_in_words(-1e308) == "-1e+308"


def test_only_what_went_wrong_is_said() -> None:
    assert went_wrong({}) == went_wrong({"issued": 9, "used": 9, "lost": 0, "transitions_received": 9}) == ""
    assert went_wrong({"lost": 1, "transitions_late": 1_200, "messages_bad": 1, "late_actions": None}) == (
        "1 rollout was lost and dealt again, 1,200 env steps came too late, 1 message could not be read"
    )
