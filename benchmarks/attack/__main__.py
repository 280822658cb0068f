"""``python -m benchmarks.attack --files 100000 --seed 0``: damaged files of every kind, and attacks on a running page.

Prints a row for each kind, and ends with 1 if anything misbehaved: a traceback, a sentence that is none, a process that
died or hung, a file that took more than 10 s or 1 GB. ``--again "KIND" NUMBER`` reads one file again and says all.
All attacks stay on this machine. Linux only.
"""

import argparse
import os
import sys
import time

from benchmarks.attack.files import LARGE_MB, SLOW_S, Tally, attack_files, attack_one
from benchmarks.attack.kinds import KINDS
from benchmarks.attack.page import attack_page

SHOWN = 5
"""Examples of what misbehaved, for each kind."""


def table(tallies: dict[str, Tally]) -> str:
    """A row for each kind, and one for all."""
    limits = (f"over {SLOW_S:g} s", f"over {LARGE_MB / 1024:g} GB")
    heads = ("kind", "tried", "sentences", "accepted", "tracebacks", "other", *limits, "slowest", "largest")
    rows: list[tuple[str, ...]] = []
    sums = [0] * 7
    for name, tally in tallies.items():
        told = [tally.outcomes[outcome] for outcome in ("sentence", "accepted", "traceback")]
        counts = (tally.tried, *told, tally.tried - sum(told), tally.slow, tally.large)
        sums = [before + count for before, count in zip(sums, counts, strict=True)]
        most = (f"{tally.slowest_s:.2f} s", f"{tally.most_mb:.0f} MB")
        rows.append((name, *(f"{count:,}" for count in counts), *most))
    rows.append(("all", *(f"{count:,}" for count in sums), "", ""))
    widths = [max(len(row[column]) for row in (heads, *rows)) for column in range(len(heads))]
    lines = (
        (row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)))
        for row in (heads, *rows)
    )
    return "\n".join("  ".join(line) for line in lines)


def main() -> int:
    """Read the command line, attack, and print."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--files", type=int, default=2000)
    words.add_argument("--seed", type=int, default=0)
    words.add_argument("--workers", type=int, default=max(1, (os.cpu_count() or 2) // 2))
    words.add_argument("--kind", action="append", choices=list(KINDS), help="one or more; all if not given")
    words.add_argument(
        "--requests",
        type=int,
        default=300,
        help="to the page, to its address for drops, and so many messages through its websocket",
    )
    words.add_argument("--again", nargs=2, metavar=("KIND", "NUMBER"))
    given = words.parse_args()
    if given.again:
        tally = attack_one(given.again[0], int(given.again[1]), given.seed)
        print(tally.outcomes, *(answer["wrong"] for answer in tally.wrong), sep="\n")
        return bool(tally.wrong)
    start, shown = time.monotonic(), 0.0

    def told(done: int) -> None:
        nonlocal shown
        if time.monotonic() > shown + 30.0:
            shown = time.monotonic()
            print(f"{done:,} files, {shown - start:.0f} s", file=sys.stderr, flush=True)

    tallies = (
        attack_files(given.files, given.seed, given.workers, given.kind or list(KINDS), told) if given.files else {}
    )
    if given.requests:
        tallies |= attack_page(given.requests, given.seed)
    print(table(tallies))
    wrong = [(name, answer) for name, tally in tallies.items() for answer in tally.wrong]
    for name in tallies:
        for answer in [answer for other, answer in wrong if other == name][:SHOWN]:
            what = f"{answer['outcome']}, {answer['seconds']:.1f} s, {answer['peak_mb']:.0f} MB"
            print(f'\n--again "{name}" {answer["number"]} ({answer["file"]}): {what}')
            print(answer["wrong"] or answer["said"])
    print(f"\nseed {given.seed}, {time.monotonic() - start:.0f} s, {len(wrong)} misbehaved")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
