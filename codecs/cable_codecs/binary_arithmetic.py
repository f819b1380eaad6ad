"""Adaptive binary arithmetic coding in integers, for a few thousand decisions.

The interval is [low, high] of 32 bits. Each context has two counts, one for each value of a bit; a bit divides
the interval in proportion, and the part for 1 lies below. Bytes on which both ends agree are written at once,
so no carry arises. The coder is the one of lpaq (Mahoney), with counts in place of probabilities.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from cable_codecs.errors import CodecError

INTERVAL_MASK = 0xFFFFFFFF
COUNT_STEP = 5
COUNT_LIMIT = 1024
"""Where both counts of a context together exceed it, each is halved, rounded up."""

Counts = Sequence[tuple[int, int]]
"""For each context what its counts of 0 and of 1 start at."""


def encode_decisions(decisions: Iterable[tuple[int, int]], start: Counts) -> bytes:
    """Code a sequence of (context, bit).

    The data are the shortest that lead a decoder, which reads zeros past the end, to the same decisions.
    """
    zeros = [count[0] for count in start]
    ones = [count[1] for count in start]
    low, high = 0, INTERVAL_MASK
    data = bytearray()
    for context, bit in decisions:
        count_one = ones[context]
        count = zeros[context] + count_one
        middle = low + (high - low) * count_one // count
        if bit:
            high = middle
            ones[context] = count_one + COUNT_STEP
        else:
            low = middle + 1
            zeros[context] += COUNT_STEP
        if count > COUNT_LIMIT - COUNT_STEP:
            zeros[context] = (zeros[context] + 1) >> 1
            ones[context] = (ones[context] + 1) >> 1
        while not (low ^ high) >> 24:
            data.append(low >> 24)
            low = low << 8 & INTERVAL_MASK
            high = high << 8 & INTERVAL_MASK | 0xFF
    return bytes(data) + last_bytes(low)


def last_bytes(low: int) -> bytes:
    """What ends the data: nothing, or the top byte of the lowest number of the interval whose other bytes are 0."""
    # The top bytes of both ends differ, so rounding up stays in the interval.
    return bytes([-(-low >> 24)]) if low else b""


@dataclass(frozen=True, slots=True)
class DecisionDecoder:
    """What undoes `encode_decisions`, one decision at a time."""

    decide: Callable[[int], int]
    """The next bit, 0 or 1, of a context; raises CodecError past the end and beyond the most decisions allowed."""
    finish: Callable[[], None]
    """Raises CodecError unless the data end where their last decision did, just as an encoder ends them."""


def open_decisions(data: bytes, start: Counts, most_decisions: int) -> DecisionDecoder:
    """Begin to decode what `encode_decisions` returned.

    Its state is in local variables: attributes would take a third longer in a call made for every cell.

    Args:
        data: The coded decisions.
        start: The starting counts they were coded with.
        most_decisions: Decisions after which the data are refused, to bound the time that hostile data take.
    """
    zeros = [count[0] for count in start]
    ones = [count[1] for count in start]
    low, high = 0, INTERVAL_MASK
    padded = data + bytes(4)
    value = int.from_bytes(padded[:4], "big")
    following = 4
    decisions_left = most_decisions

    def decide(context: int) -> int:
        nonlocal low, high, value, following, decisions_left
        if not decisions_left:
            raise CodecError(f"coded mask needs more than {most_decisions} decisions; it is damaged")
        decisions_left -= 1
        count_one = ones[context]
        count = zeros[context] + count_one
        middle = low + (high - low) * count_one // count
        if value <= middle:
            bit = 1
            high = middle
            ones[context] = count_one + COUNT_STEP
        else:
            bit = 0
            low = middle + 1
            zeros[context] += COUNT_STEP
        if count > COUNT_LIMIT - COUNT_STEP:
            zeros[context] = (zeros[context] + 1) >> 1
            ones[context] = (ones[context] + 1) >> 1
        while not (low ^ high) >> 24:
            if following >= len(padded):
                raise CodecError("coded mask is cut short or damaged")
            low = low << 8 & INTERVAL_MASK
            high = high << 8 & INTERVAL_MASK | 0xFF
            value = value << 8 & INTERVAL_MASK | padded[following]
            following += 1
        return bit

    def finish() -> None:
        rest, expected = data[following - 4 :], last_bytes(low)
        if len(rest) < len(expected):
            raise CodecError("coded mask is cut short or damaged")
        if len(rest) > len(expected):
            raise CodecError(f"coded mask is followed by {len(rest) - len(expected)} bytes of other data, or damaged")
        if rest != expected:
            raise CodecError("coded mask is damaged: it doesn't end as an encoder would end it")

    return DecisionDecoder(decide, finish)
