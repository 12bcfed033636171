"""Answers a learner that does not know its environment yet: makes one env copy, describes it and closes it.

Rule: the environment's code runs here and not in the learner. The description is sent before the copy is closed, so that a
copy whose `close` raises or hangs cannot take the description with it.
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
from millrace.protocol.envs.which_copy import FIRST_COPY
from millrace.protocol.errors import EnvironmentFailed, UsageError, first_line
from millrace.protocol.space_spec import EnvDescription
from millrace.protocol.specs import DescribeSpec
from millrace.workers.activity import DESCRIBING, activity
from millrace.workers.copy_slots import close_copy, make_copy


@contextmanager
def describing(spec: DescribeSpec) -> Iterator[EnvDescription]:
    """The description of the environment; its copy is closed afterwards, whatever `close` raises.

    Raises `UsageError`, with advice, if the environment cannot be what the learner asks for: its id is unknown, a package
    is missing, or its spaces are not supported. Raises `EnvironmentFailed` for any exception of its own code, and for an
    exit of the process that its code asks for.
    """
    page = activity()
    with _failures_of(spec.env), page.during(DESCRIBING):
        env = make_copy(FIRST_COPY, lambda: spec.env.make(spec.render_mode))
    try:
        with _failures_of(spec.env), page.during(DESCRIBING):
            _check_kind(spec, env)
            description = describe_env(env)
        yield description
    finally:
        close_copy(env)


@contextmanager
def _failures_of(env: EnvSpec) -> Iterator[None]:
    try:
        yield
    except UsageError as error:
        if error.detail:  # its constructor raised
            raise EnvironmentFailed(str(error), error.detail) from error
        raise
    except BaseException as error:
        line = f"environment {env.id} cannot be made: {type(error).__name__}: {first_line(error)}"
        raise EnvironmentFailed(line, traceback.format_exc()) from error


def _check_kind(spec: DescribeSpec, env: gymnasium.Env[object, object]) -> None:
    """Raise `UsageError` unless the env copies that the learner asks for have the spaces of this single copy."""
    if isinstance(env, SeatedEnv):
        return  # the learner refuses all but a loop
    spaces_of = copies_kind(spec.vector).spaces
    if spaces_of is None:
        return
    observed, acted = spaces_of(spec.env)
    expected = observation_leaves(env.observation_space), action_spec(env.action_space)
    if (observation_leaves(observed), action_spec(acted)) != expected:
        raise UsageError(
            f"environment {spec.env.id}: vector {spec.vector}: its copies have other spaces than itself, {observed} and "
            f"{acted}; {instead_of_vector(spec.env.id)}"
        )
