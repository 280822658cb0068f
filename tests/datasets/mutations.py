"""Damaged files for tests of parsers."""

from hypothesis import strategies as st

PIECES = [b"\n", b" ", b"nan", b"inf", b"-", b"1e999", b"9" * 400, b"\xff", b"\x00", b"#", b":", b"_", b"0x1", b","]


@st.composite
def mutations(draw, content):
    """``content`` with pieces overwritten, inserted, removed or repeated, bits flipped, and perhaps cut off."""
    data = bytearray(content.encode() if isinstance(content, str) else content)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        size = draw(st.integers(0, 12))
        twice = bytes(data[at : at + size]) * 2
        piece = draw(st.one_of(st.binary(max_size=4), st.sampled_from(PIECES), st.just(twice)))
        data[at : at + draw(st.sampled_from([0, size]))] = piece
        if data and draw(st.booleans()):
            data[draw(st.integers(0, len(data) - 1))] ^= 1 << draw(st.integers(0, 7))
    if draw(st.booleans()) and draw(st.booleans()):
        del data[draw(st.integers(0, len(data))) :]
    return bytes(data)
