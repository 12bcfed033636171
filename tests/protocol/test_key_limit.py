"""The keys of all dicts of a value count together, by the squares of their numbers."""

from __future__ import annotations

from millrace.protocol.bounds import MOST_OTHER_KEYS
from millrace.protocol.key_limit import KeyLimit


def test_one_dict_has_a_limit_of_its_own() -> None:
    assert KeyLimit().allows(MOST_OTHER_KEYS)
    assert not KeyLimit().allows(MOST_OTHER_KEYS + 1)


def test_the_squares_of_all_dicts_have_a_limit() -> None:
    limit = KeyLimit()
    assert all(limit.allows(MOST_OTHER_KEYS // 2) for _ in range(4))
    assert not limit.allows(1)
    assert limit.allows(0)


def test_a_dict_that_grows_counts_once() -> None:
    limit = KeyLimit()
    assert all(limit.allows(keys, keys - 1) for keys in range(1, MOST_OTHER_KEYS + 1))
    assert not limit.allows(1)


def test_a_dict_that_is_refused_does_not_count() -> None:
    limit = KeyLimit()
    assert not limit.allows(MOST_OTHER_KEYS + 1)
    assert limit.allows(MOST_OTHER_KEYS)


def test_several_values_have_the_limits_of_all_of_them_but_one_dict_does_not() -> None:
    limit = KeyLimit(3)
    assert not limit.allows(MOST_OTHER_KEYS + 1)
    assert all(limit.allows(MOST_OTHER_KEYS) for _ in range(3))
    assert not limit.allows(1)
