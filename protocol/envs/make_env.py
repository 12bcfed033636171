"""Makes an environment with `gymnasium.make` or a user-defined callable, or says in one line why that failed."""

from __future__ import annotations

import difflib
import importlib
import pkgutil
import sys
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec as GymnasiumSpec

from millrace.protocol.envs.advice.atari_ids import preprocessed
from millrace.protocol.envs.advice.config_dict import wants_a_dict
from millrace.protocol.envs.advice.files_as_modules import module_of_file
from millrace.protocol.envs.advice.missing_modules import what_to_install
from millrace.protocol.envs.advice.old_gym import instead_of_id, instead_of_object, is_of_old_gym
from millrace.protocol.envs.advice.several_agents import what_it_lacks
from millrace.protocol.envs.found_names import attribute, names_a_function, names_a_module
from millrace.protocol.envs.seats import has_seats
from millrace.protocol.envs.unknown_ids import most_similar, what_to_write
from millrace.protocol.envs.which_copy import FIRST_COPY, EnvCopy, being_made, takes_copy
from millrace.protocol.errors import UsageError, first_line, joined, words_an_error


@words_an_error
def _newer_or_older(module: str) -> str:
    """A suggestion of another version of a module in the same package, as the end of a line; empty if no name is similar."""
    package, _, name = module.rpartition(".")
    beside = [each.name for each in pkgutil.iter_modules(getattr(sys.modules.get(package), "__path__", []))]
    return "".join(f"; did you mean {package}.{close}?" for close in difflib.get_close_matches(name, beside, 1, cutoff=0.75))


def made_by_id(env_id: str, kwargs: dict[str, Any]) -> Any:
    """Make the environment with this id, or call the function or class with this name."""
    module_name, _, name = env_id.partition(":")
    if names_a_module(env_id):
        module = importlib.import_module(env_id)
        return made_by_callable(env_id, getattr(module, "parallel_env", None) or module.env, kwargs)
    if names_a_function(env_id):
        function = attribute(importlib.import_module(module_name), name)
        if callable(function) and name not in gymnasium.registry:
            return made_by_callable(env_id, function, kwargs)
    return made_without_checker(env_id, kwargs)


def made_without_checker(env: str | GymnasiumSpec, kwargs: dict[str, Any]) -> gymnasium.Env[Any, Any]:
    """Make an environment without gymnasium's checker, which would make a CartPole step a tenth slower.

    `rollout_checks.validate` checks rows instead. The spec of the environment is set to the registered one, so that a
    dataset's environment equals the one that gymnasium makes.
    """
    made = gymnasium.make(env, disable_env_checker=True, **kwargs)
    if (spec := made.spec) is not None:
        registered = gymnasium.registry.get(spec.id, spec) if isinstance(env, str) else env
        spec.disable_env_checker = registered.disable_env_checker
    return made


def made_by_callable(name: str, factory: Callable[..., object], kwargs: dict[str, Any]) -> Any:
    """Call a user-defined callable, and return the `gymnasium.Env` or PettingZoo environment that it returns.

    Raises `UsageError` if it returns anything else, or requests an unknown id from gymnasium.
    """
    parameter = takes_copy(factory, kwargs)
    copy = [being_made() or FIRST_COPY] if parameter else []
    try:
        made = factory(*copy, **kwargs)
    except (TypeError, AttributeError) as error:
        if advice := wants_a_dict(name, factory, kwargs, error):
            raise UsageError(f"environment {name}: {type(error).__name__}: {first_line(error)}: {advice}") from error
        if not parameter or EnvCopy.__name__ not in first_line(error):
            raise
        raise UsageError(
            f"environment {name}: {first_line(error)}: its argument {parameter}, which has no default, got the EnvCopy; "
            f"if it is something else, give it: --env-kwargs {parameter} VALUE"
        ) from error
    except gymnasium.error.UnregisteredEnv as error:
        raise UsageError(
            f"environment {name}: it asks gymnasium for an id that is not registered in the worker ({first_line(error)}); "
            "pass the id itself or gymnasium.spec(id) instead of a callable, or let it make module:id, where the module "
            "registers it"
        ) from error
    if isinstance(made, gymnasium.Env) or has_seats(made):
        return made
    line = f"env factory {name}: expected it to return an environment of gymnasium or PettingZoo, got {type(made).__name__}"
    raise UsageError(joined(line, _what_to_return(made)))


@words_an_error
def _what_to_return(made: object) -> str:
    """What a callable should return instead of something that isn't an environment."""
    if is_of_old_gym(made):
        return instead_of_object(made)
    if hasattr(made, "num_envs"):
        return "it is a vector environment: return one copy; millrace makes as many as it needs"
    if hasattr(made, "observation_spec") and hasattr(made, "action_spec"):
        return (
            "it has the interface of dm_env: `pip install shimmy`, and return shimmy.DmControlCompatibilityV0(env), or "
            "shimmy.BSuiteCompatibilityV0(env) if it is bsuite's"
        )
    return what_it_lacks(made)


def why_not_made(
    env_id: str, error: Exception, failed: Sequence[str] = (), why_not: Callable[[str], str] = lambda env_id: ""
) -> str:
    """One line that says why an environment cannot be made. For the arguments, see `_why_not_made`."""
    says = first_line(error)
    return _why_not_made(env_id, error, failed, why_not) or f"environment {env_id} cannot be made: {says}"


@words_an_error
def _why_not_made(env_id: str, error: Exception, failed: Sequence[str], why_not: Callable[[str], str]) -> str:
    """One line for an environment that is unknown or lacks a package; empty for other errors.

    `failed` has lines about installed packages that could not register their environments. For `why_not`, see
    `what_to_write`.
    """
    if instead := module_of_file(env_id, "MyEnv"):
        return f"environment {env_id}: {instead}"
    module, colon, name = env_id.partition(":")
    while isinstance(error, ModuleNotFoundError) and isinstance(error.__cause__, ModuleNotFoundError):
        error = error.__cause__  # gymnasium's own error names the module of the id, whichever module is missing
    says = first_line(error)
    match error:
        case gymnasium.error.NamespaceNotFound() if env_id.startswith("ALE/"):
            return f"environment {env_id}: Atari games need ale-py; {what_to_install('ale_py')}"
        case gymnasium.error.DependencyNotInstalled():
            return f"environment {env_id}: {says}"
        case ModuleNotFoundError(name=str(missing)) if colon and f"{module}.".startswith(f"{missing}."):
            return f"environment {env_id}: no module named {module}; is it installed, or its folder on PYTHONPATH?"
        case ModuleNotFoundError(name=missing) if missing == env_id:  # only the module is missing, not its package
            return f"environment {env_id}: {says}{_newer_or_older(env_id)}"
        case ModuleNotFoundError(name=missing):
            return f"environment {env_id}: a package it needs is missing ({says}); {what_to_install(missing)}"
        case ImportError():
            return f"environment {env_id} cannot be imported: {says}"
        case gymnasium.error.Error() if "vector entry point" in says:
            return (
                f"environment {env_id} has no vectorized form of its own (gymnasium's vector_entry_point); use --vector loop"
            )
        case gymnasium.error.UnregisteredEnv() if env_id.rpartition(":")[2] in gymnasium.registry:
            return f"environment {env_id} cannot be made: {says}"  # its code asks for an id that isn't registered
        case gymnasium.error.UnregisteredEnv() if ours := preprocessed(env_id):
            return f"environment {env_id} is not registered: write {ours}"
        case gymnasium.error.UnregisteredEnv() if not colon:
            broken = f" ({'; '.join(failed)})" if failed else ""
            advice = what_to_write(env_id, why_not)
            return f"environment {env_id} is not registered{f': {advice}' if advice else ''}{broken}"
        case gymnasium.error.UnregisteredEnv() if wrapped := instead_of_id(env_id):
            return f"environment {env_id} is of the old package gym; {wrapped}"
        case gymnasium.error.UnregisteredEnv():
            there = vars(sys.modules.get(module, object))
            names = [f"{module}:{each}" for each, value in there.items() if callable(value)]
            hint = most_similar(name, names, why_not)
            return f"environment {env_id}: module {module} neither registers {name} nor has such a class or function" + (
                f"; {hint}" if hint else ""
            )
        case TypeError() if "missing" in says and "argument" in says:
            return (
                f"environment {env_id} cannot be made: {says}; give numbers and text as --env-kwargs NAME VALUE; for "
                "anything else, name a function of your own that makes the environment: my_module:make_env"
            )
        case _:
            return f"environment {env_id} cannot be made: {says}"
