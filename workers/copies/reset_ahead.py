"""`millrace:ResetAhead`, a wrapper for environments whose reset is slow: the next episode is prepared while this one runs.

Rule: which instance plays an episode, and with which random numbers, depends on the resets before it and never on time. A
reset with a seed or options is done immediately, by the instance that plays. The first reset without them makes a second
instance in a thread. From then on, the two take turns: one plays while the thread resets the other.
"""

from __future__ import annotations

import threading
from concurrent.futures import Future
from contextlib import suppress
from copy import deepcopy
from typing import Any

import gymnasium

from millrace.protocol.envs.which_copy import FIRST_COPY, being_made
from millrace.protocol.errors import UsageError
from millrace.protocol.random_streams import Purpose, env_seed
from millrace.workers.copy_slots import give_back, make_copy

Prepared = tuple[gymnasium.Env[Any, Any], Any, dict[str, Any]]  # an instance, its first observation and its first info


class ResetAhead(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment that resets a second instance of itself while an episode runs.

    Use it as the innermost wrapper, so that other wrappers see one environment. It needs the memory of two instances. A
    reset overlaps with steps if either of them waits or releases Python's global interpreter lock, as most simulators do.

    Both instances are made with the same arguments. If the constructor needs a port or a folder, let it call
    `millrace.env_copy()`, because the second instance has its own slot.

    Attributes that a run or a vector environment sets on its environment are set on both instances, but by then the next
    episode's reset may already be done.

    >>> import gymnasium, millrace
    >>> env = millrace.ResetAhead(gymnasium.make("CartPole-v1"))
    >>> observation, info = env.reset(seed=1)
    >>> observation, info = env.reset()
    >>> env.close()
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        """Wrap an environment. Raises `UsageError` unless `gymnasium.make` made it, because the second instance is made in
        the same way.
        """
        super().__init__(env)
        if env.spec is None:
            raise UsageError(
                f"ResetAhead: expected an environment of gymnasium.make, got {type(env).__name__} without a spec"
            )
        self._spec = env.spec
        self._copy = being_made() or FIRST_COPY
        self._second: gymnasium.Env[Any, Any] | None = None
        self._second_seed: int | None = None  # seed for the second instance's next reset
        self._prepared: Future[Prepared] | None = None
        self._late: dict[str, Any] = {}  # attributes for the second instance, which lacks them until its first reset

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See `gymnasium.Env.reset`. If the prepared reset has raised, raises its exception."""
        if seed is not None or options is not None:
            self._finish()
            self._second_seed = None if seed is None else env_seed(seed, Purpose.SECOND_INSTANCE)
            return self.env.reset(seed=seed, options=options)
        if self._prepared is None:
            self._prepare(self._second)
            return self.env.reset()
        prepared = self._prepared
        self._prepared = None
        played = self.env
        self.env, observation, info = prepared.result()
        self._second = played
        self._prepare(played)
        return observation, info

    def _make(self) -> gymnasium.Env[Any, Any]:
        return make_copy(self._copy, lambda: gymnasium.make(self._spec))

    def _prepare(self, instance: gymnasium.Env[Any, Any] | None) -> None:
        """Reset the second instance in a thread. If it is None, make it first."""
        prepared: Future[Prepared] = Future()
        seed = self._second_seed
        self._second_seed = None

        def prepare() -> None:
            try:
                env = self._make() if instance is None else instance
                self._second = env
                first = env.reset(seed=seed)
                for name in list(self._late):  # if one can't be set, a later reset sets the rest
                    _set(env, name, self._late.pop(name))
                prepared.set_result((env, *first))
            except BaseException as error:
                prepared.set_exception(error)

        self._prepared = prepared
        threading.Thread(target=prepare, name="reset-ahead", daemon=True).start()

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        """See `gymnasium.Wrapper.set_wrapper_attr`. An attribute of the environment is set on both instances.

        Waits for a reset in progress. The other instance gets a copy of the value, because an instance may change its value.
        If the other instance lacks the attribute, because `reset` creates it, the instance gets it after its first reset. If
        the instance lacks it even then, raises `AttributeError`, or lets a later `reset` raise it if that first reset
        hasn't happened yet.
        """
        if hasattr(self, name) or not self.env.has_wrapper_attr(name):
            return super().set_wrapper_attr(name, value, force=force)
        playing, other = self.instances()
        if self._prepared is None and not other.has_wrapper_attr(name):
            self._late[name] = deepcopy(value)
        else:
            _set(other, name, deepcopy(value))
            self._late.pop(name, None)  # an older value, if the reset after which it was to be set has failed
        return playing.set_wrapper_attr(name, value)

    def instances(self) -> tuple[gymnasium.Env[Any, Any], gymnasium.Env[Any, Any]]:
        """The instance that plays, and the other one. Waits for a reset of the other one to end."""
        if self._prepared is not None:
            with suppress(BaseException):  # the next call to `reset` raises it
                self._prepared.result()
        if self._second is None:
            self._second = self._make()
        return self.env, self._second

    def _finish(self) -> None:
        """Wait until the reset in progress, if any, is finished, and discard its result."""
        prepared = self._prepared
        self._prepared = None
        if prepared is not None:
            with suppress(BaseException):
                prepared.result()

    def close(self) -> None:
        """Close both instances."""
        self._finish()
        if self._second is not None:
            with suppress(Exception):
                self._second.close()
        try:
            super().close()
        finally:
            give_back(self.env)  # for both instances, because they have taken turns
            give_back(self._second)


def _set(env: gymnasium.Env[Any, Any], name: str, value: Any) -> None:
    """Set an attribute that the instance has. A new one would belong to a wrapper, and hide that of the environment."""
    if not env.set_wrapper_attr(name, value, force=False):
        raise AttributeError(
            f"expected an attribute {name} of both instances of ResetAhead, got one of the playing instance only"
        )
