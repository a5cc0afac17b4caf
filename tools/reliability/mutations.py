"""Mutations of files: bits, bytes, pieces, numbers in digits, and values inside a valid container."""

from __future__ import annotations

import random
import re
from collections.abc import Callable

import numpy as np

NUMBERS = (b"nan", b"inf", b"-1", b"0", b"1e999", b"4294967296", b"99999999999999999999", b"-0.0", b"2147483647", b"")
WORDS = (b"\x00\x00\x00\x00", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\x00\x00\xc0\x7f")
EXTREMES = (np.nan, np.inf, -np.inf, 1e30, -1e30, 1e-45, 0.0, -1.0, 2**31, -(2**31), 255, 1e300)


def flip_bits(data: bytes, rng: random.Random) -> bytes:
    """Flips of one to eight bits."""
    mutated = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        mutated[rng.randrange(len(mutated))] ^= 1 << rng.randrange(8)
    return bytes(mutated)


def set_bytes(data: bytes, rng: random.Random) -> bytes:
    """Extreme values in one to eight bytes, or words of four, of the header or anywhere."""
    mutated, reach = bytearray(data), rng.choice((len(data), min(len(data), 400)))
    for _ in range(rng.randint(1, 8)):
        word = rng.choice((*WORDS, bytes([rng.randrange(256)])))
        place = rng.randrange(reach)
        mutated[place : place + len(word)] = word
    return bytes(mutated)


def cut_and_splice(data: bytes, rng: random.Random) -> bytes:
    """Removal, duplication or move of a piece, or truncation."""
    start = rng.randrange(len(data))
    length = rng.choice((rng.randint(1, 64), rng.randint(1, len(data))))
    piece, rest = data[start : start + length], data[:start] + data[start + length :]
    where = rng.randrange(len(rest) + 1)
    doubled, moved = data[:start] + piece + data[start:], rest[:where] + piece + rest[where:]
    return rng.choice((rest, doubled, moved, data[:start]))


def set_numbers(data: bytes, rng: random.Random) -> bytes:
    """Extreme values for one to four of the numbers in digits; bytes where there are none."""
    found = list(re.finditer(rb"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?", data))
    if not found:
        return set_bytes(data, rng)
    for match in sorted(rng.sample(found, min(len(found), rng.randint(1, 4))), key=lambda m: -m.start()):
        data = data[: match.start()] + rng.choice(NUMBERS) + data[match.end() :]
    return data


def mutate_array(array: np.ndarray, rng: random.Random) -> np.ndarray:
    """Array with some entries extreme, fewer or more rows, another type, or other axes."""
    kind = rng.randrange(5)
    if array.dtype.kind not in "biuf" or not array.size:
        return np.array([["x" * rng.randint(0, 80)]] if kind else rng.choice(("../../x", "", "\0", "nan")))
    if kind < 2:
        with np.errstate(all="ignore"):
            mutated = array.astype(np.float64) if kind and array.dtype.kind == "f" else array.copy()
            for _ in range(rng.randint(1, 4)):
                mutated.flat[rng.randrange(mutated.size)] = np.array(rng.choice(EXTREMES)).astype(mutated.dtype)
        return mutated
    if kind == 2:
        return array[: rng.randint(0, len(array))] if array.ndim else array[None]
    if kind == 3:
        with np.errstate(all="ignore"):
            return array.astype(rng.choice((np.float64, np.float16, np.int8, np.uint64, np.complex64, bool)))
    return rng.choice((array[None], array.T, np.concatenate([array.reshape(-1)] * 2)))


MUTATORS: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "bits": flip_bits,
    "bytes": set_bytes,
    "pieces": cut_and_splice,
    "numbers": set_numbers,
}
INSIDE = "values"  # the fifth: `formats.Format.mutate_values` unpacks, mutates and packs again, with valid checksums
