"""Makes an env copy for a learner that does not know the environment yet, and describes it.

Rule: the environment's code runs here and not in the learner. A copy is made and its attributes are read; it is not reset or
stepped. Then the copy is kept for later use (`copy_slots.py`).
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager

import gymnasium

from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.advice.atari_ids import instead_of_vector
from millrace.protocol.envs.description import describe_env
from millrace.protocol.envs.kinds_of_copies import copies_kind
from millrace.protocol.envs.seats import SeatedEnv
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import EnvironmentFailed, UsageError, first_line
from millrace.protocol.messages import Describe
from millrace.protocol.space_spec import EnvDescription
from millrace.workers.activity import DESCRIBING, activity
from millrace.workers.copy_slots import EnvMaker, close_copy, keep_described, make_to_describe


def describe(order: Describe) -> EnvDescription:
    """Make a copy of the environment, and describe it. The copy is kept, to be used as the next one that this thread makes.

    Raises `UsageError`, with advice, if the order can't be fulfilled: the id is unknown, a package is missing, or the spaces
    are not supported. Raises `EnvironmentFailed` if the environment's own code raises, or tries to exit the process.
    """
    with _failures_of(order.env), activity().during(DESCRIBING):
        made = make_to_describe(EnvMaker(order.env, order.render_mode))
        try:
            _check_kind(order, made.copy)
            description = describe_env(made.copy)
        except BaseException:
            close_copy(made.copy)
            raise
    keep_described(made)
    return description


@contextmanager
def _failures_of(env: EnvSpec) -> Iterator[None]:
    try:
        yield
    except UsageError as error:
        if error.detail:  # a traceback: the environment's constructor has raised
            raise EnvironmentFailed(str(error), error.detail) from error
        raise
    except BaseException as error:
        line = f"environment {env.id} cannot be made: {type(error).__name__}: {first_line(error)}"
        raise EnvironmentFailed(line, traceback.format_exc()) from error


def _check_kind(order: Describe, env: gymnasium.Env[object, object]) -> None:
    """Raise `UsageError` unless env copies of the kind that the learner asks for have the same spaces as this
    single copy.
    """
    if isinstance(env, SeatedEnv):
        return  # with seats, the learner refuses all kinds but a loop
    spaces_of = copies_kind(order.vector).spaces
    if spaces_of is None:
        return
    observed, acted = spaces_of(order.env)
    expected = observation_leaves(env.observation_space), action_spec(env.action_space)
    if (observation_leaves(observed), action_spec(acted)) != expected:
        raise UsageError(
            f"environment {order.env.id}: vector {order.vector}: its copies have other spaces than itself, {observed} and "
            f"{acted}; {instead_of_vector(order.env.id)}"
        )
