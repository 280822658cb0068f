"""Frames of a sequence that stand out from those before and after them: a Markdown table of simulated sequences.

    .venv/bin/python -m benchmarks.jumps     # a minute

Sequences of 8 to 60 frames, some of them without a pose, of cameras that move in different ways, and photographs in no
order. In one column all poses are right; in the other one frame is put 6 to 20 m away.
"""

from collections.abc import Callable, Mapping

import numpy as np

from spherloc.experiments.results import FAILED, LOCALIZED, QueryResult
from spherloc.geometry import pose
from spherloc.mapping.scenes.neighbours import MIN_FRAMES, jumps
from spherloc.types import FloatArray

SEQUENCES, SEED, NOISE_M, LIMIT_M = 400, 0, 0.03, 0.5
Places = Callable[[np.random.Generator, int], FloatArray]
"""Draws places (K, 3), metres, of so many frames."""


def walked(ways_m: FloatArray, turns_rad: FloatArray) -> FloatArray:
    """Places (K, 3) of a walk with these ways (K,) and turns (K,)."""
    headings = np.cumsum(turns_rad)
    return np.cumsum(ways_m[:, None] * np.column_stack([np.cos(headings), 0.0 * headings, np.sin(headings)]), axis=0)


def walk(rng: np.random.Generator, count: int) -> FloatArray:
    """A walk with turns, also back."""
    turns = rng.choice([0.0, np.pi / 2, -np.pi / 2, np.pi], count, p=[0.8, 0.08, 0.08, 0.04])
    return walked(rng.uniform(0.5, 1.5, count), turns + 0.1 * rng.standard_normal(count))


def stop_and_go(rng: np.random.Generator, count: int) -> FloatArray:
    """A walk with stops of some frames."""
    goes = (np.arange(count) // rng.integers(3, 7)) % 2
    return walked(goes * rng.uniform(0.5, 2.0, count), 0.2 * rng.standard_normal(count))


def loops(rng: np.random.Generator, count: int) -> FloatArray:
    """Around and around, twelve frames each time."""
    return walked(rng.uniform(0.8, 1.2, count), np.full(count, np.pi / 6))


def there_and_back(rng: np.random.Generator, count: int) -> FloatArray:
    """Two frames to one side, two to the other."""
    return walked(rng.uniform(0.2, 3.0, count), np.pi * (np.arange(count) % 2 == 0))


def car(rng: np.random.Generator, count: int) -> FloatArray:
    """A car that stops at lights."""
    speeds = rng.uniform(2.0, 6.0, count) * np.abs(np.sin(np.arange(count) / 7)) + 0.05
    return walked(speeds, 0.05 * rng.standard_normal(count))


def standing(rng: np.random.Generator, count: int) -> FloatArray:
    """A camera that hardly moves, with errors of decimetres now and then."""
    return 0.1 * rng.standard_normal((count, 3)) * (rng.random((count, 1)) < 0.1)


def no_order(rng: np.random.Generator, count: int) -> FloatArray:
    """Photographs of a house in no order."""
    return rng.uniform(0.0, 20.0, (count, 3)) * [1.0, 0.1, 1.0]


def _visits(rng: np.random.Generator, count: int, rooms: int, most: int, spread_m: float) -> FloatArray:
    places: list[FloatArray] = []
    rooms_at = rng.uniform(0.0, 30.0, (rooms, 3))
    while len(places) < count:
        here = rooms_at[rng.integers(rooms)]
        places += [here + spread_m * rng.standard_normal(3) for _ in range(rng.integers(1, most))]
    return np.array(places[:count])


def rooms(rng: np.random.Generator, count: int) -> FloatArray:
    """One to three photographs in one of five rooms, then in another."""
    return _visits(rng, count, 5, 4, 0.5)


def tripod(rng: np.random.Generator, count: int) -> FloatArray:
    """One to seven photographs from one of six places, then from another."""
    return _visits(rng, count, 6, 8, 0.01)


KINDS: Mapping[str, Places] = {
    "walk with turns": walk,
    "walk with stops": stop_and_go,
    "loops": loops,
    "there and back": there_and_back,
    "car": car,
    "standing": standing,
    "no order": no_order,
    "no order, some in each room": rooms,
    "no order, some on each tripod": tripod,
}


def sequence(rng: np.random.Generator, places: Places, gaps: bool, wrong: bool) -> tuple[list[QueryResult], str]:
    """The rows of a sequence, and the name of the frame that is wrong, if one is to be."""
    count = int(rng.integers(MIN_FRAMES, 60))
    numbers = np.cumsum(rng.choice([1, 20], count, p=[0.8, 0.2])) if gaps else np.arange(count)
    at = places(rng, int(numbers[-1]) + 1)[numbers] + NOISE_M * rng.standard_normal((count, 3))
    posed = rng.random(count) >= rng.choice([0.0, 0.2, 0.5])
    inner = np.flatnonzero(posed)[1:-1]
    moved = int(rng.choice(inner)) if wrong and len(inner) else -1
    if moved >= 0:
        at[moved] += [rng.uniform(6.0, 20.0), 0.0, 0.0]
    rows = [
        QueryResult(k, f"frame_{number:05d}.png", LOCALIZED, cam_from_map=pose(np.eye(3), -at[k]))
        if posed[k]
        else QueryResult(k, f"frame_{number:05d}.png", FAILED)
        for k, number in enumerate(numbers.tolist())
    ]
    return rows, rows[moved].query if moved >= 0 else ""


def main() -> None:
    """Print the table."""
    rng = np.random.default_rng(SEED)
    print("| | all right: sequences with a doubt | one wrong: told | others told |\n|---|---|---|---|")
    for kind, places in KINDS.items():
        for gaps in (False, True) if kind == "walk with turns" else (False,):
            doubts = sum(bool(jumps(sequence(rng, places, gaps, False)[0], LIMIT_M)) for _ in range(SEQUENCES))
            hits = others = tried = 0
            for _ in range(SEQUENCES):
                rows, wrong = sequence(rng, places, gaps, True)
                found = jumps(rows, LIMIT_M)
                tried += bool(wrong)
                hits += wrong in found
                others += len(found) - (wrong in found)
            print(f"| {kind}{', gaps' * gaps} | {doubts} of {SEQUENCES} | {hits} of {tried} | {others} |", flush=True)


if __name__ == "__main__":
    main()
