"""Mistakes made on purpose in the coordinator, the session and what they are made of: the checker finds each of them."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.model.mutations import MUTATIONS
from tests.test_architecture import ROOT


def test_a_mistake_is_found_and_told_as_a_story() -> None:
    """One mistake that only liveness shows, in every `make test`, so that it is known that the checker can fail."""
    story = find("a lost Collect is not sent again")
    assert "Collect(session 0, 0, ((ticket 0, 0, incarnation 0:0),)," in story
    assert " to worker 0 is lost." in story
    assert story.endswith("Then: and so on: the run never reaches its target")


@pytest.mark.model
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", MUTATIONS)
def test_every_mistake_is_found(name: str) -> None:
    assert "\nThen: " in find(name)


def find(name: str) -> str:
    """What the checker says of the program with this mistake."""
    command = [sys.executable, "-m", "tests.model.mutations", name]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=1200, check=False)
    assert result.returncode == 1, f"not found: {name}\n{result.stdout}{result.stderr}"
    return result.stdout


def test_every_mutation_fits_the_program() -> None:
    for name, mutation in MUTATIONS.items():
        text = (ROOT / (mutation.module.replace(".", "/") + ".py")).read_text()
        assert text.count(mutation.right) == 1, f"{name}: expected this once in {mutation.module}: {mutation.right}"
