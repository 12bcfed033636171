"""Finds the containers that contain themselves. Pure; takes time in proportion to the number of references."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from graphlib import CycleError, TopologicalSorter
from typing import Any


def in_cycles(outermost: object, containers_in: Callable[[Any], list[Any]], most: int) -> set[int]:
    """The `id` of each container inside the outermost one, or itself, that contains itself or is between two such.

    `containers_in` returns the containers that are directly in a container. If there are more than `most` containers, the
    others count as empty.
    """
    inside: dict[int, list[Any]] = {}  # the containers themselves, so that no two of them get the same id
    left = [outermost]
    while left and len(inside) < most:
        container = left.pop()
        if id(container) not in inside:
            inside[id(container)] = containers_in(container)
            left += inside[id(container)]
    leads = _left_over({each: list(map(id, inner)) for each, inner in inside.items()})
    around: dict[int, list[int]] = {each: [] for each in leads}
    for each in leads:
        for inner in map(id, inside[each]):
            if inner in leads:
                around[inner].append(each)
    return _left_over(around)


def _left_over(before: Mapping[int, Iterable[int]]) -> set[int]:
    """What can't be sorted such that each comes after those `before` it, because these include itself, or lead to it."""
    sorter = TopologicalSorter(before)
    with suppress(CycleError):
        sorter.prepare()
    left = set(before)
    while ready := sorter.get_ready():
        left.difference_update(ready)
        sorter.done(*ready)
    return left
