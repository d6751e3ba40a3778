"""Damaged copies of a file, the same for equal seeds."""

from collections.abc import Iterator
from random import Random

_MOST_BYTES = 256


def mutations(data: bytes, seed: int, count: int) -> Iterator[tuple[str, bytes]]:
    """Yield `count` damaged copies of `data`, each with a name that says what was done and where.

    The kinds alternate: flipped bits, a zeroed block, a cut end, a block twice, random bytes, bytes inserted.
    """
    for number in range(count):
        random = Random(f"{seed} {number}")
        damage = _KINDS[number % len(_KINDS)]
        start, damaged = damage(data, random)
        yield f"{number}: {damage.__name__.strip('_')} at {start} of {len(data)}", damaged


def _span(data: bytes, random: Random) -> tuple[int, int]:
    """A random part of the data; short parts are as likely as long ones."""
    start = random.randrange(len(data) + 1)
    return start, min(len(data), start + 2 ** random.randrange(_MOST_BYTES.bit_length()))


def _flipped_bits(data: bytes, random: Random) -> tuple[int, bytes]:
    flipped, start = bytearray(data), len(data)
    for _ in range(random.choice((1, 1, 2, 8)) if data else 0):
        start = random.randrange(len(data))
        flipped[start] ^= 1 << random.randrange(8)
    return start, bytes(flipped)


def _zeroed_block(data: bytes, random: Random) -> tuple[int, bytes]:
    start, end = _span(data, random)
    return start, data[:start] + bytes(end - start) + data[end:]


def _cut_end(data: bytes, random: Random) -> tuple[int, bytes]:
    start = random.randrange(len(data) + 1)
    return start, data[:start]


def _block_twice(data: bytes, random: Random) -> tuple[int, bytes]:
    start, end = _span(data, random)
    return start, data[:end] + data[start:end] + data[end:]


def _random_bytes(data: bytes, random: Random) -> tuple[int, bytes]:
    start, end = _span(data, random)
    return start, data[:start] + random.randbytes(end - start) + data[end:]


def _inserted_bytes(data: bytes, random: Random) -> tuple[int, bytes]:
    start, end = _span(data, random)
    return start, data[:start] + random.randbytes(end - start) + data[start:]


_KINDS = (_flipped_bits, _zeroed_block, _cut_end, _block_twice, _random_bytes, _inserted_bytes)
