"""Damages files: by a random generator, so that a seed and a number give the same file again."""

import os
import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

PIECES = (
    *(
        b"\n",
        b" ",
        b"#",
        b":",
        b",",
        b"_",
        b"-",
        b"\r",
        b"\t",
        b'"',
        b"'",
        b"[",
        b"]",
        b"{",
        b"}",
        b"&a",
        b"*a",
        b"=",
        b"|",
    ),
    *(b"\xff", b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"\xed\xa0\x80", b"\0" * 8, b"\xff" * 8),
    *(b"../", b"/dev/zero", b"a/" * 200, b"n" * 300, "\u202e\u0000\u0661".encode()),
)
NUMBERS = (
    *(
        b"nan",
        b"inf",
        b"-inf",
        b".inf",
        b"1e999",
        b"1e308",
        b"-1e308",
        b"1e-308",
        b"1e-30",
        b"1e19",
        b"-1",
        b"0",
        b"-0.0",
    ),
    *(b"1_0", b"0x1", b"9" * 400, b"2147483648", b"-2147483649", b"9223372036854775808", b"1e5", b"100000000", b"true"),
    *(b"''", b"[]", b"{}", b"null", "\u0663".encode(), b"1e", b"+", b"0.5e-5"),
)
WORDS = tuple(
    struct.pack(form, value)
    for form, value in (
        *(("<d", value) for value in (np.nan, np.inf, -np.inf, 1e308, 1e-308, -1.0, 0.0)),
        *(("<f", value) for value in (np.nan, np.inf, 3e38, -1.0)),
        *(("<q", value) for value in (-1, 1 << 31, 1 << 40, (1 << 63) - 1, 0, 10**9)),
        *(("<i", value) for value in (-1, 1 << 30, 0, 1 << 16)),
    )
)
WHOLE = (
    b"",
    b"\n",
    b"\0" * 4096,
    b"\xff" * 4096,
    b"a" * 200_000,
    b"[" * 100_000,
    b"a = " + b"[" * 20_000,
    b'{"a":' * 20_000,
    b"a: " + b"{b: " * 5_000,
    b"a: " + b"[" * 20_000,
    b"x0: &x0 [lol,lol,lol,lol,lol,lol,lol,lol,lol]\n"
    + b"".join(b"x%d: &x%d [%s]\n" % (k, k, b",".join([b"*x%d" % (k - 1)] * 9)) for k in range(1, 12)),
    b"cam0: &a {b: *a}\n",
    b"1 2 3\n" * 20_000,
    b"1," * 100_000,
    b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "bbbbbbbb"><!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;">]><a>&c;</a>',
    b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\x7f\xff\xff\xff\x7f\xff\xff\xff\x08\x02\0\0\0" + b"\0" * 64,
    b"\x89HDF\r\n\x1a\n" + b"\xff" * 256,
    b"RRF2" + b"\xff" * 256,
    b"SQLite format 3\0" + b"\xff" * 256,
)
"""Files that are something else, or made to take long."""

Change = Callable[[bytearray, np.random.Generator], None]


def _cut(data: bytearray, rng: np.random.Generator) -> None:
    del data[int(rng.integers(len(data) + 1)) :]


def _flip(data: bytearray, rng: np.random.Generator) -> None:
    for place in rng.integers(len(data), size=rng.integers(1, 4)):
        data[place] ^= 1 << int(rng.integers(8))


def _piece(data: bytearray, rng: np.random.Generator) -> None:
    """Something inserted, or put over as many bytes."""
    at, piece = int(rng.integers(len(data) + 1)), _one_of(PIECES, rng)
    data[at : at + (len(piece) if rng.integers(2) else 0)] = piece


def _noise(data: bytearray, rng: np.random.Generator) -> None:
    at, size = int(rng.integers(len(data) + 1)), int(rng.integers(1, 64))
    data[at : at + (size if rng.integers(2) else 0)] = rng.bytes(size)


def _word(data: bytearray, rng: np.random.Generator) -> None:
    """A number as programs store it, at a place where one may be."""
    word = _one_of(WORDS, rng)
    at = int(rng.integers(len(data) // 4 + 1)) * 4
    data[at : at + len(word)] = word


def _number(data: bytearray, rng: np.random.Generator) -> None:
    """A number that can be read, replaced."""
    found = list(re.finditer(rb"-?\d[\d.eE+-]*", bytes(data)))
    if not found:
        return _word(data, rng)
    match = found[int(rng.integers(len(found)))]
    data[match.start() : match.end()] = _one_of(NUMBERS, rng)


def _lines(data: bytearray, rng: np.random.Generator) -> None:
    """Lines dropped, repeated, or exchanged."""
    lines = bytes(data).splitlines(keepends=True)
    if len(lines) < 2:
        return _noise(data, rng)
    one, other = (int(place) for place in rng.integers(len(lines), size=2))
    kind = rng.integers(3)
    if kind == 0:
        del lines[one]
    elif kind == 1:
        lines[one:one] = [lines[other]] * int(rng.integers(1, 50))
    else:
        lines[one], lines[other] = lines[other], lines[one]
    data[:] = b"".join(lines)


def _repeat(data: bytearray, rng: np.random.Generator) -> None:
    at, size = int(rng.integers(len(data) + 1)), int(rng.integers(1, 4096))
    data[at:at] = data[at : at + size] * int(rng.integers(1, 20))


CHANGES: tuple[Change, ...] = (_cut, _flip, _piece, _noise, _word, _number, _number, _lines, _repeat)


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """A change, or up to four; now and then another file altogether."""
    if rng.random() < 0.03:
        return _one_of(WHOLE, rng)
    data = bytearray(content)
    for _ in range(int(rng.choice((1, 1, 1, 1, 2, 3, 4)))):
        if not data:
            break
        CHANGES[int(rng.integers(len(CHANGES)))](data, rng)
    return bytes(data)


def misplaced(path: Path, rng: np.random.Generator) -> None:
    """In place of a file what is none: nothing, a folder, a pipe, an endless device, a link to itself."""
    path.unlink()
    kind = rng.integers(5)
    if kind == 0:
        return
    if kind == 1:
        path.mkdir()
    elif kind == 2:
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero" if kind == 3 else path.name)


def _one_of(choices: tuple[bytes, ...], rng: np.random.Generator) -> bytes:
    return choices[int(rng.integers(len(choices)))]
