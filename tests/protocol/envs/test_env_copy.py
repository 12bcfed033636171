"""Which copy is being made: what texts in braces become, and which factories get it."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import gymnasium
import pytest

from millrace.protocol.env_spec import AllowedCode, EnvSpec
from millrace.protocol.envs.which_copy import EnvCopy, Making, filled, making, takes_copy
from millrace.protocol.errors import UsageError
from tests.support.envs.toy import Countdown

MODULE = __name__
COPY = EnvCopy(number=7, lane=3, copy=1, evaluation=False, slot=12)


@pytest.fixture(autouse=True)
def under_way() -> Iterator[Making]:
    """`COPY` is being made."""
    with making(COPY) as found:
        yield found


@pytest.mark.parametrize(
    ("given", "value"),
    [
        ("{number}", 7),
        ("{ 5000 + slot }", 5012),
        ("{number % 4}", 3),
        ("{-(number - 9) * 2 // 3}", 1),
        ("{lane * 10 + copy}", 31),
        ("sim-{slot}/lane{lane}", "sim-12/lane3"),
        ("{number} ", "7 "),
        ('{"port": {5000 + slot}, "task": {number % 4}}', '{"port": 5012, "task": 3}'),
    ],
)
def test_expressions_of_a_copy_are_computed(given: str, value: object) -> None:
    assert filled({"x": given}, "Env-v0") == {"x": value}
    assert type(filled({"x": given}, "Env-v0")["x"]) is type(value)


@pytest.mark.parametrize(
    "given",
    [
        '{"number": 3}',
        "{}",
        "a{3}",  # as in a regular expression
        "{number",
        "{numbers}",
        "{number ** 2}",
        "{number / 2}",
        "{number.real}",
        "{number.__class__}",
        "{abs(number)}",
        "{number(lane)}",
        "{number if lane else copy}",
        "{number + 1.5}",
        "{number +}",
        "{evaluation}",
        "{" + "number+" * 20 + "1}",  # longer than anybody needs
        3,
        2.5,
        True,
    ],
)
def test_anything_else_stays_as_it_is(given: object) -> None:
    value = filled({"x": given}, "Env-v0")["x"]
    assert (value, type(value)) == (given, type(given))


def test_a_division_by_zero_names_the_argument_and_the_copy() -> None:
    with pytest.raises(
        UsageError, match=r"^environment E-v0: argument \{1 % \(lane - 3\)\}: it divides by zero for EnvCopy\("
    ):
        filled({"port": "{1 % (lane - 3)}"}, "E-v0")


def test_an_id_gets_them_from_a_learner_that_may_be_anybody() -> None:
    spec = EnvSpec("CartPole-v1", {"max_episode_steps": "{number + 10}"}, eval_kwargs={"max_episode_steps": "{number * 2}"})
    assert not spec.rejection_reason(AllowedCode.REGISTERED)
    assert [str(each.make().spec).count("max_episode_steps=17") for each in (spec, spec.for_evaluation())] == [1, 0]
    assert "max_episode_steps=14" in str(spec.for_evaluation().make().spec)


def test_a_vectorized_form_gets_those_of_the_first_copy() -> None:
    env = EnvSpec("CartPole-v1", {"max_episode_steps": "{number}"}).make_vectorized(2)
    assert env.unwrapped.max_episode_steps == 7  # type: ignore[attr-defined]
    env.close()


# --------------------------------------------------------------------------------------------------------- factories


class Told(Countdown):
    """Keeps what it was made with."""

    def __init__(self, copy: Any, *more: Any, **options: Any) -> None:
        super().__init__(3)
        self.copy, self.more, self.options = copy, more, options


def of_name(copy: EnvCopy, size: int = 2, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
    return Told(copy, size=size, render_mode=render_mode)


def places(places: Any) -> gymnasium.Env[Any, Any]:
    return Countdown(places + 1)


def broken(copy: EnvCopy) -> gymnasium.Env[Any, Any]:
    return Countdown("three" + 3)  # type: ignore[operator]


def test_a_factory_with_one_argument_gets_the_copy() -> None:
    for given in (of_name, f"{MODULE}:of_name", f"{MODULE}:Told", lambda which: Told(which), lambda which, /: Told(which)):
        env = EnvSpec.of(given).make()
        assert isinstance(env, Told)
        assert env.copy == COPY
    env = EnvSpec.of(of_name, {"size": 5}).make("rgb_array")
    assert isinstance(env, Told)
    assert (env.copy, env.options) == (COPY, {"size": 5, "render_mode": "rgb_array"})


def test_one_that_is_given_the_argument_gets_what_is_given() -> None:
    env = EnvSpec.of(of_name, {"copy": 5}).make()
    assert isinstance(env, Told)
    assert env.copy == 5


@pytest.mark.parametrize(
    "factory",
    [
        lambda: None,
        lambda copy=3: None,
        lambda *copies: None,
        lambda **copies: None,
        lambda *, copy: None,
        lambda copy, other: None,  # which of the two?
        lambda size=3, *, copy: None,
        lambda render_mode: None,
        functools.partial(of_name, EnvCopy()),
        dict,  # has no signature
    ],
)
def test_other_factories_get_nothing(factory: Any) -> None:
    assert takes_copy(factory, {}) == ""


def test_only_the_first_parameter_gets_the_copy() -> None:
    assert takes_copy(lambda size, copy: None, {"size": 5}) == ""
    assert takes_copy(lambda copy, size: None, {"size": 5}) == "copy"


def test_who_forgot_an_argument_reads_which_one() -> None:
    with pytest.raises(
        UsageError,
        match=r"^environment .*:places: unsupported operand .*'EnvCopy' and 'int': its argument places, which has no "
        r"default, got the EnvCopy; if it is something else, give it: --env-kwargs places VALUE$",
    ):
        EnvSpec(f"{MODULE}:places").make()
    with pytest.raises(UsageError, match=r"cannot be made: can only concatenate str"):  # it is not the copy's fault
        EnvSpec(f"{MODULE}:broken").make()
