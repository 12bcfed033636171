"""What others' extras may build on stays small, is documented, and imports nothing that is slow."""

from __future__ import annotations

import inspect
import subprocess
import sys

from millrace import door
from tests.test_architecture import ROOT, SLOW_TO_IMPORT

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


def test_it_imports_nothing_that_is_slow() -> None:
    asks = f"import sys, millrace.door; assert not sys.modules.keys() & {SLOW_TO_IMPORT}"
    done = subprocess.run([sys.executable, "-c", asks], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
