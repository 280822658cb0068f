"""A condition on steps as a person types it, checked word by word, since the engine that runs it can do much more."""

import re

import pyarrow as pa

from spherloc.errors import InputError, show

STEP_COLUMNS = {
    "step": pa.int64(),
    "stage": pa.string(),
    "key": pa.string(),
    "agreeing": pa.int64(),
    "rotation_error_deg": pa.float64(),
    "position_error_m": pa.float64(),
}
"""What is known of a step: its index, the stage that it belongs to, its name within that, matches that agree, and how
far its pose is off."""
RUN_COLUMNS = {
    "created": pa.string(),
    "source": pa.string(),
    "scene": pa.string(),
    "name": pa.string(),
    "estimator": pa.string(),
    "seed": pa.int64(),
    "outcome": pa.string(),
    "diagnosis": pa.string(),
    "doubtful": pa.bool_(),
    "correspondences": pa.int64(),
    "inliers": pa.int64(),
    "outlier_rate": pa.float64(),
    "steps": pa.int64(),
    "key_step": pa.int64(),
    "time_ms": pa.float64(),
}
"""What is known of its run."""
COLUMNS = STEP_COLUMNS | RUN_COLUMNS
WORDS = ("and", "or", "not", "in", "is", "null", "between", "like", "true", "false")
"""All of SQL that a condition may say: no word that reads a file, names a table, or asks a second question."""
MOST_CHARACTERS = 1_000
MOST_PARENTHESES = 50

_PIECE = re.compile(
    r"\s+|(?P<word>[A-Za-z_]\w*)|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(?![\w.])|(?P<text>'(?:[^']|'')*')"
    r"|<=|>=|<>|!=|[<>=+\-*/%(),]",
    re.ASCII,
)


def checked_condition(text: str) -> str:
    """The condition, if it compares columns, numbers and texts and does nothing else.

    Raises ``InputError``, which says what cannot be understood and what there is.
    """
    if len(text) > MOST_CHARACTERS or text.count("(") > MOST_PARENTHESES:
        raise InputError(
            f"a condition may have {MOST_CHARACTERS:,} characters and {MOST_PARENTHESES} parentheses: shorten it."
        )
    pieces: list[str] = []
    place = 0
    while place < len(text):
        piece = _PIECE.match(text, place)
        if piece is None:
            raise InputError(
                f"the condition cannot be understood at {show(text[place : place + 20])}: "
                "give one such as position_error_m < 0.1 AND stage = 'Refinement'."
            )
        word = piece["word"]
        if word is not None and word not in COLUMNS and word.lower() not in WORDS:
            raise InputError(f"unknown column {show(word)}: a condition knows {', '.join(COLUMNS)}.")
        # Two minus signs would begin a comment.
        pieces.append(" - " if piece[0] == "-" else " / " if piece[0] == "/" else piece[0])
        place = piece.end()
    if not text.strip():
        raise InputError("the condition is empty: give one such as position_error_m < 0.1 AND stage = 'Refinement'.")
    return "".join(pieces)
