"""The letters of the Rerun viewer's font. For others it has at best a box, and without a window it stops at one."""

import re

DRAWN = (
    "\n\x20-\x7e\xa0-\u0148\u014a-\u01c3\u01c5-\u031e\u0384-\u038a\u038e-\u03a1\u03a3-\u03e1\u03f0-\u049d\u04a0-\u04ff"
    "\u1d4f\u2010-\u2027\u202f-\u205e\u2070\u2071\u2074-\u208e\u2090-\u209c\u20a0-\u20bf\u2190-\u2199\u21d0\u21d2\u21d4"
    "\u2202\u2205\u2206\u220f\u2211\u2212\u221a\u221e\u222b\u2248\u2260\u2264\u2265"
)
"""Ranges of what its font, Inter, has of Latin, Greek and Cyrillic letters and of signs."""
INSTEAD = str.maketrans({"ᵀ": "^T", "∝": "~", "∈": "in"})
"""What our own words have beside those."""
UNKNOWN = "?"

_OTHERS = re.compile(f"[^{DRAWN}]")


def legible(text: str) -> str:
    """The text with a question mark for every letter that the viewer's font lacks."""
    return _OTHERS.sub(UNKNOWN, text.translate(INSTEAD))
