"""Sixteen numbers at once: every lane does what the scalar operation does, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest

from clothgym._jit import bits, device, lanes, lower, lowest_bit, upper

ODD = np.array([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, 1e-45, -1e-45, 3.4e38, -3.4e38, 1e30], np.float32)


@device
def arithmetic(numbers, b, x, out):
    first = lanes(numbers, b, 0)
    second = lanes(numbers, b, 1)
    masks = (
        bits(first > second), bits(first >= x), bits(second <= first), bits((first > x) & (second > x)),
        bits((first > x) | (second > x)), bits(lower(first, second) >= x), bits(upper(first, x) > second),
        bits(first + second > x), bits(x - first >= second), bits(first * second - x <= first),
    )  # fmt: skip
    for n in range(len(masks)):
        out[n] = masks[n]


@device
def others(ids, b, v):
    return bits(lanes(ids, b, 1) != v)


@device
def lowest(mask):
    return lowest_bit(mask)


def expected(first, second, x):
    low, high = np.where(first < second, first, second), np.where(first > x, first, x)
    return [
        first > second, first >= x, second <= first, (first > x) & (second > x),
        (first > x) | (second > x), low >= x, high > second,
        first + second > x, x - first >= second, first * second - x <= first,
    ]  # fmt: skip


def as_mask(truths):
    return sum(1 << n for n, truth in enumerate(truths) if truth)


@pytest.mark.parametrize("seed", range(3))
def test_lanes_do_what_numbers_do(seed):
    rng = np.random.default_rng(seed)
    numbers = rng.normal(0, 1, (5, 2, 16)).astype(np.float32)
    numbers = np.where(rng.random(numbers.shape) < 0.4, rng.choice(ODD, numbers.shape), numbers)
    numbers[:, 1] = np.where(rng.random((5, 16)) < 0.2, numbers[:, 0], numbers[:, 1])
    out = np.zeros(10, np.uint64)
    for b in range(len(numbers)):
        for x in (*ODD, numbers[b, 0, 3]):
            arithmetic(numbers, b, x, out)
            with np.errstate(all="ignore"):
                assert out.tolist() == [as_mask(truths) for truths in expected(*numbers[b], x)]


def test_a_block_need_not_begin_at_a_cache_line():
    room = np.zeros(3 * 2 * 16 + 3, np.float32)
    numbers = room[3:].reshape(3, 2, 16)
    numbers[2, 0] = np.arange(16)
    out = np.zeros(10, np.uint64)
    arithmetic(numbers, 2, np.float32(9.5), out)
    assert int(out[1]) == 0xFC00


def test_ids_are_compared_as_whole_numbers():
    ids = np.full((2, 4, 16), 2**24, np.int32)
    ids[1, 1, 5] += 1  # the same in single precision
    assert others(ids, 1, np.int32(2**24)) == 1 << 5
    assert others(ids, 1, np.int32(-1)) == 0xFFFF


def test_the_lowest_bit():
    assert [lowest(np.uint64(1 << n | 1 << 63)) for n in range(64)] == list(range(64))
