"""OCamCalib's ``calib_results.txt``: lines of numbers between comments that say what they are.

The toolbox counts rows and columns from the centre of the top-left pixel, (0, 0). Its x axis points down along the
rows, its y axis to the right and its z axis backwards.
"""

from spherloc.cameras._checks import finite
from spherloc.cameras._files import PIXEL_CENTRE_SHIFT
from spherloc.cameras.ocam import MAX_TERMS, Ocam
from spherloc.errors import CalibrationError, show

MARK = "ocam_model.ss"
"""Text in the file's first comment."""
_PARTS = (
    "the polynomial of cam2world",
    "that of world2cam",
    "the centre, row and column",
    "the affine parameters c, d, e",
    "the image size, height and width",
)


def is_ocam(text: str) -> bool:
    """Whether a text is such a file, by its first line with content."""
    first = next((line for line in text.splitlines() if line.strip()), "")
    return first.lstrip().startswith("#") and (MARK in first or "DIRECT mapping function" in first)


def ocam(text: str) -> Ocam:
    """The camera of such a file; the inverse polynomial, a fit, is not used.

    Raises ``CalibrationError``, with the line, if a part is missing or a word is not a number.
    """
    lines = [(number, line.split()) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, words) for number, words in lines if words and not words[0].startswith("#")]
    if len(lines) != len(_PARTS):
        missing = f"{_PARTS[len(lines)]} is missing" if len(lines) < len(_PARTS) else "there are more lines of numbers"
        raise CalibrationError(
            f"has {len(lines)} lines of numbers where OCamCalib writes {len(_PARTS)}: {missing}, give the file as the "
            "toolbox wrote it."
        )
    direct, _, centre, affine, size = (
        _numbers(number, words, part) for (number, words), part in zip(lines, _PARTS, strict=True)
    )
    for (number, _), values, count, part in zip(lines[2:], (centre, affine, size), (2, 3, 2), _PARTS[2:], strict=True):
        if len(values) != count:
            raise CalibrationError(f"line {number} has {len(values)} numbers: give {part}.")
    if int(direct[0]) != direct[0] or not 1 <= direct[0] <= MAX_TERMS or len(direct) != direct[0] + 1:
        raise CalibrationError(
            f"line {lines[0][0]} begins with {direct[0]:g}, and {len(direct) - 1} numbers follow: give the number of "
            f"coefficients, up to {MAX_TERMS}, and the coefficients."
        )
    c, d, e = affine
    row, column = centre
    height, width = (int(side) if side == int(side) else side for side in size)
    # Row and column are c x' + d y' and e x' + y' of their x' down and y' right.
    return Ocam(
        width,  # pyright: ignore[reportArgumentType] -- whole or refused
        height,  # pyright: ignore[reportArgumentType]
        column + PIXEL_CENTRE_SHIFT,
        row + PIXEL_CENTRE_SHIFT,
        (1.0, e, d, c),
        tuple(-value for value in direct[1:]),
    )


def _numbers(number: int, words: list[str], part: str) -> list[float]:
    values = []
    for word in words:
        try:
            values.append(finite(part, float(word)))
        except (ValueError, CalibrationError):
            raise CalibrationError(f"line {number}: {show(word)} is not a finite number: give {part}.") from None
    return values
