"""Random streams depend on their whole key and on nothing else."""

import numpy as np
import pytest
from scipy import stats

from solar_cli.streams import Streams


def numbers(streams: Streams, *key: str | int) -> list[float]:
    return streams.generator(*key).standard_normal(4).tolist()


def test_the_same_key_gives_the_same_numbers_whatever_was_drawn_before():
    alone = numbers(Streams(3), "minibatch", "attempt 0", 7)
    streams = Streams(3)
    for step in range(7):
        streams.generator("minibatch", "attempt 0", step).standard_normal(1000)
    streams.generator("a stream that came later").standard_normal(10)
    assert numbers(streams, "minibatch", "attempt 0", 7) == alone
    assert numbers(streams, "minibatch", "attempt 0", 7) == alone


def test_a_prefix_is_the_front_of_the_key():
    streams = Streams(5)
    expected = numbers(streams, "environment", 2, 0, "reset", 9)
    assert numbers(streams.under("environment"), 2, 0, "reset", 9) == expected
    assert numbers(streams.under("environment").under(2, 0), "reset", 9) == expected


def test_distinct_keys_are_distinct_streams():
    keys: list[tuple[str | int, ...]] = [
        *((), ("",), ("", ""), ("a",), ("b",), ("ab",), ("a", "b"), ("b", "a"), ("a, b",)),
        *(("a', 'b",), (1,), ("1",), (12,), (1, 2), ("1", 2), (-1,), ("a", 1, 2), ("a", 12)),
    ]
    found = {Streams(seed).entropy(*key) for seed in (0, 1, 2**40) for key in keys}
    assert len(found) == 3 * len(keys)


def test_a_seed_is_not_a_key():
    assert Streams(1).entropy(2) != Streams(2).entropy(1)
    assert Streams(1, ("a",)).entropy() == Streams(1).entropy("a")


def test_neighbouring_keys_are_statistically_independent():
    # One draw of each of 4000 streams whose keys differ in one number, and its successor's.
    draws = np.array([Streams(0).generator("reset", i).uniform() for i in range(4000)])
    assert stats.kstest(draws, "uniform").pvalue > 1e-4
    assert stats.pearsonr(draws[:-1], draws[1:]).pvalue > 1e-4


@pytest.mark.parametrize("key", range(50))
def test_seeds_of_foreign_generators_fit_into_63_bits(key: int):
    assert 0 <= Streams(0).seed63(key) < 2**63


def test_stored_runs_find_their_streams_again():
    # Written down once: a change of these numbers would break the resuming of stored runs.
    assert Streams(7).entropy("weights", 0) == 22349230811481259089444906891476503093
    assert Streams(7).generator("weights", 0).integers(10**6, size=3).tolist() == [
        667701,
        827524,
        788113,
    ]
