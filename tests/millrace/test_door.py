"""What others' extras may build on stays small and is documented."""

from __future__ import annotations

import inspect

from millrace import door

MOST_NAMES = 40


def test_it_holds_few_functions_and_classes_that_are_documented() -> None:
    assert len(door.__all__) <= MOST_NAMES
    for name in door.__all__:
        value = getattr(door, name)
        assert inspect.isclass(value) or inspect.isfunction(value), name
        assert (value.__doc__ or "").strip(), name


def test_nothing_is_in_it_but_what_it_lists_and_its_head_names_each() -> None:
    public = {name for name, value in vars(door).items() if inspect.isclass(value) or inspect.isfunction(value)}
    assert public == {*door.__all__}
    assert not [name for name in door.__all__ if f"`{name}`" not in (door.__doc__ or "")]
