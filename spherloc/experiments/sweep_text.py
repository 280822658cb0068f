"""The values of a sweep as people type them."""

import math
from collections.abc import Sequence

from spherloc.errors import InputError, show
from spherloc.experiments.sweep_plan import MOST_VALUES


def parse_values(texts: Sequence[str]) -> tuple[float, ...]:
    """Numbers from texts such as "0.5:0.9:0.1" (first, last, step; the last one included) and "0.5,0.7".

    Raises ``InputError`` for a text of another form.
    """
    found: list[float] = []
    for text in (part for whole in texts for part in whole.split(",")):
        try:
            numbers = [float(word) for word in text.split(":")]
        except ValueError:
            numbers = []
        if len(numbers) == 1:
            found += numbers
        elif len(numbers) == 3 and all(map(math.isfinite, numbers)) and numbers[2] > 0 and numbers[1] >= numbers[0]:
            first, last, step = numbers
            count = math.floor((last - first) / step + 1e-6) + 1 if last - first < MOST_VALUES * step else math.inf
            if count > MOST_VALUES:
                raise InputError(f"the values {show(text)} are more than {MOST_VALUES}; give a larger step.")
            found += [round(first + k * step, 10) for k in range(int(count))]
        else:
            raise InputError(f"the values {show(text)} are none; give numbers, or FIRST:LAST:STEP such as 0.5:0.9:0.1.")
    return tuple(found)
