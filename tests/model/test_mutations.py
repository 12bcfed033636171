"""Mistakes made on purpose in the coordinator, the session and what they are made of: the checker finds each of them."""

from __future__ import annotations

import pytest

from tests.model.mutations import MUTATIONS, check_that_they_fit, find


def test_a_mistake_is_found_and_told_as_a_story() -> None:
    """One mistake that only liveness shows, in every `make test`, so that it is known that the checker can fail."""
    story = find("a lost Collect is not sent again")
    assert "Collect(session 0, 0, ((ticket 0, 0, incarnation 0:0, 0),)," in story
    assert " to worker 0 is lost." in story
    assert story.endswith("Then: and so on: the run never reaches its target")


@pytest.mark.model
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", MUTATIONS)
def test_every_mistake_is_found(name: str) -> None:
    find(name)


def test_every_mutation_fits_the_program() -> None:
    check_that_they_fit(MUTATIONS)
