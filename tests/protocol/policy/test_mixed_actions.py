"""Actions of a Dict or Tuple: the distributions of torch are the judge, part by part, of the nested spaces of the toy."""

from __future__ import annotations

import itertools
import math
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch import distributions as judges

from millrace.protocol.action_parts import make_nest, mixed, parts_of
from millrace.protocol.arrays import Array
from millrace.protocol.envs.spaces import action_spec
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.layout import parameter_layout
from millrace.protocol.policy.possible import why_impossible
from millrace.protocol.policy.torch_distributions import log_prob_and_entropy
from millrace.protocol.rows.array_checks import wrong_values
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec
from tests.support.envs.toy import ACTIONS
from tests.support.examples import examples

SPEC = action_spec(ACTIONS["mixed"])  # of all four kinds, nested
POLICY = PolicySpec((Leaf("", "box", (3,), "float32"),), SPEC, (8,))
SIZES = (3, 2, 3, 4, 5, 4)  # of its choices; then 2 bits, and 3 numbers
BITS = 2
NUMBERS = 3
LOGITS = sum(SIZES)
ALMOST_NEVER = 6  # standard deviations: once in 10⁹ cases


def random_params(rows: int, seed: int = 0) -> Array:
    """[rows, P] float64."""
    return np.random.default_rng(seed).normal(0, 1, (rows, LOGITS + BITS + 2 * NUMBERS))


def judged(params: Tensor) -> list[tuple[judges.Distribution, slice]]:
    """The distribution of each part in the order of a stored row, with its columns."""
    found: list[tuple[judges.Distribution, slice]] = []
    at = 0
    for entry, size in enumerate(SIZES):
        found.append((judges.Categorical(logits=params[:, at : at + size]), slice(entry, entry + 1)))
        at += size
    bits = judges.Bernoulli(logits=params[:, at : at + BITS])
    mean, log_std = params[:, at + BITS :].chunk(2, -1)
    found.append((bits, slice(len(SIZES), len(SIZES) + BITS)))
    found.append((judges.Normal(mean, log_std.exp()), slice(len(SIZES) + BITS, None)))
    return found


def summed(each: Tensor) -> Tensor:
    return each.reshape(len(each), -1).sum(-1)


def test_log_probability_and_entropy_are_the_sums_of_those_that_torch_has_of_each_part() -> None:
    params = torch.tensor(random_params(200))
    parts = judged(params)
    drawn = torch.cat([part.sample().double().reshape(200, -1) for part, _ in parts], -1)
    log_prob, entropy = log_prob_and_entropy(SPEC, params, drawn)
    of_parts = []
    for part, columns in parts:
        value = drawn[:, columns]
        of_parts.append(summed(part.log_prob(value[:, 0] if isinstance(part, judges.Categorical) else value)))
    torch.testing.assert_close(log_prob, torch.stack(of_parts).sum(0), rtol=1e-12, atol=1e-12)
    expected = torch.stack([summed(part.entropy()) for part, _ in parts]).sum(0)
    torch.testing.assert_close(entropy, expected, rtol=1e-12, atol=1e-12)
    in_numpy = distribution(POLICY).log_prob(params.float().numpy(), drawn.float().numpy())
    # 11 sums of numbers up to 20, in float32
    np.testing.assert_allclose(in_numpy, log_prob.numpy(), rtol=0, atol=11 * 20 * float(np.finfo(np.float32).eps))


def test_samples_have_the_frequencies_and_the_means_of_each_part() -> None:
    rows = 40_000
    params = random_params(1)
    over = distribution(POLICY)
    repeated = np.repeat(params, rows, 0).astype(np.float32)
    drawn = over.sample(repeated, over.noise(np.random.default_rng(1), (rows,)))
    assert (drawn.dtype, drawn.shape) == (np.dtype(np.float32), (rows, *SPEC.shape))
    assert wrong_values(drawn, SPEC, ("row",)) == ""
    for part, columns in judged(torch.tensor(params)):
        found = drawn[:, columns]
        if isinstance(part, judges.Categorical):
            chances = part.probs[0].numpy()
            counts = np.bincount(found[:, 0].astype(int), minlength=len(chances))
            deviations = np.sqrt(rows * chances * (1 - chances))
            assert (np.abs(counts - rows * chances) < ALMOST_NEVER * deviations).all()
        else:
            mean, deviation = part.mean[0].numpy(), part.stddev[0].numpy()
            assert (np.abs(found.mean(0) - mean) < ALMOST_NEVER * deviation / math.sqrt(rows)).all()
            # Of a normal number z, z² has a variance of 2; that of a bit is below it.
            spread = np.square((found - mean) / deviation)
            assert (np.abs(spread.mean(0) - 1) < ALMOST_NEVER * 5 / math.sqrt(rows)).all()
    independent = np.corrcoef(drawn.T) - np.eye(drawn.shape[1])
    assert np.abs(independent).max() < ALMOST_NEVER / math.sqrt(rows)


def test_the_mode_is_that_of_each_part() -> None:
    params = random_params(50)
    found = distribution(POLICY).mode(params.astype(np.float32))
    expected = torch.cat([part.mode.double().reshape(50, -1) for part, _ in judged(torch.tensor(params))], -1)
    np.testing.assert_array_equal(found, expected.float().numpy())


def test_only_the_numbers_have_a_standard_deviation() -> None:
    shapes = {field.name: field.shape for field in parameter_layout(POLICY)[0]}
    assert shapes["actor.out.weight"] == (LOGITS + BITS + NUMBERS, 8)
    assert shapes["actor.log_std"] == (NUMBERS,)
    choices = action_spec(ACTIONS["pair"].spaces[0])  # type: ignore[attr-defined]
    without = msgspec.structs.replace(POLICY, action=mixed([((0,), choices), ((1,), choices)]))
    assert "actor.log_std" not in {field.name for field in parameter_layout(without)[0]}


# ------------------------------------------------------------------------------------------------ rows and structures

ORDER = {"discrete": 0, "multidiscrete": 0, "multibinary": 1, "box": 2}  # in a row
SINGLE = st.sampled_from(
    [
        ActionSpec("discrete", (), "int64", (4,), (-1,)),
        ActionSpec("multidiscrete", (2,), "int32", (2, 3), (0, 5)),
        ActionSpec("multibinary", (2, 2), "int8"),
        ActionSpec("box", (), "float64", low=(-math.inf,), high=(0.5,)),
        ActionSpec("box", (3,), "float16", low=(-1.0,) * 3, high=(1.0, 2.0, 3.0)),
    ]
)


@given(st.lists(SINGLE, min_size=1, max_size=9))
@examples(100)
def test_each_part_has_its_columns_and_is_described_as_it_was(specs: list[ActionSpec]) -> None:
    action = mixed([((number,), spec) for number, spec in enumerate(specs)])
    parts = parts_of(action)
    assert [part.spec for part in parts] == specs
    columns = sorted(column for part in parts for column in range(action.shape[0])[part.columns])
    assert columns == list(range(action.shape[0]))
    for before, after in itertools.pairwise(sorted(parts, key=lambda part: part.columns.start)):
        assert ORDER[before.spec.kind] <= ORDER[after.spec.kind]
    assert why_impossible(PolicySpec(POLICY.observation, action)) == ""


def test_values_are_nested_as_their_paths_say() -> None:
    paths = [("b", 0), ("b", 1, "x"), ("a",), ("b", 1, "1")]
    assert make_nest(paths)("pqrs") == {"b": ("p", {"x": "q", "1": "s"}), "a": "r"}
    assert make_nest([()])("p") == "p"


@pytest.mark.parametrize("paths", [[(0,), (2,)], [(1,), (0,)], [(0,), ("a",)], [(0,), (0,)], [("a",), ("a", 0)]])
def test_paths_of_no_dict_or_tuple_are_refused(paths: list[Any]) -> None:
    with pytest.raises(ValueError, match=r"^expected "):
        make_nest(paths)
    parts = tuple(msgspec.structs.replace(SPEC.parts[0], path=path) for path in paths)
    assert why_impossible(PolicySpec(POLICY.observation, msgspec.structs.replace(SPEC, parts=parts))).startswith("action: ")


@pytest.mark.parametrize(
    "change",
    [
        {"shape": (12,)},
        {"shape": (5, 2)},
        {"dtype": "float64"},
        {"sizes": SIZES[:-1]},
        {"sizes": (*SIZES, 2)},
        {"sizes": (0, *SIZES[1:])},
        {"start": SPEC.start[1:]},
        {"low": SPEC.low[1:]},
        {"high": (*SPEC.high, 1.0)},
        {"low": (math.nan, *SPEC.low[1:])},
        {"parts": ()},
        {"parts": SPEC.parts[1:]},
        {"parts": tuple(msgspec.structs.replace(part, path=(*part.path, *"abcdefghi")) for part in SPEC.parts)},
        {"parts": (msgspec.structs.replace(SPEC.parts[0], shape=(2**40,)), *SPEC.parts[1:])},
        {"kind": "box"},
    ],
    ids=str,
)
def test_a_description_that_is_none_is_refused(change: dict[str, Any]) -> None:
    why = why_impossible(msgspec.structs.replace(POLICY, action=msgspec.structs.replace(SPEC, **change)))
    assert why.startswith("action: ")
    assert "\n" not in why


@pytest.mark.parametrize(
    ("column", "value", "said"),
    [
        (0, 3, "expected 0 to 2, got 3.0 at row 1"),
        (0, -1, "expected 0 to 2, got -1.0 at row 1"),
        (5, 1.5, "expected 0 to 3, got 1.5 at row 1"),
        (7, 2, "expected 0 to 1, got 2.0 at row 1"),
        (8, math.nan, "expected finite values, got nan at row 1"),
        (8, -1e30, ""),
    ],
)
def test_each_number_of_a_row_is_checked(column: int, value: float, said: str) -> None:
    rows = np.zeros((3, *SPEC.shape), np.float32)
    rows[1, column] = value
    assert wrong_values(rows, SPEC, ("row",)) == said


@pytest.mark.parametrize("head", ["q", "squashed", "deterministic"])
def test_other_heads_have_no_such_actions(head: Any) -> None:
    assert why_impossible(msgspec.structs.replace(POLICY, head=head)).startswith(f"head {head}: expected a ")
