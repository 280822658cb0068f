"""What is claimed about speed and success, measured: python -m benchmarks.run --help

Every finished row is written at once, so that a run that was stopped goes on where it ended.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import certificate, clique, memory, proven
from benchmarks.cases import Case, aria_cases, simulated_cases
from benchmarks.machine import ROOT, describe, fingerprint, restart_on_one_core
from benchmarks.measure import measure
from benchmarks.methods import Method, our_methods
from benchmarks.table import case_lines, markdown

RESULTS = ROOT / "benchmarks" / "results"
TRIAL_RESULTS = ROOT / "build" / "benchmarks"
"""Of runs that were made smaller."""
ARIA = Path("../shared/data/aria_adt_fisheye")
QUICK_PROBLEMS = 5

Row = dict[str, Any]


def arguments(argv: list[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.run", description=__doc__)
    parser.add_argument("--case", action="append", metavar="NAME", help="only this row (may be repeated)")
    parser.add_argument("--problems", type=int, metavar="N", help="at most N problems a method")
    parser.add_argument("--method", action="append", metavar="NAME", help="only this method (may be repeated)")
    parser.add_argument("--quick", action="store_true", help=f"the same as --problems {QUICK_PROBLEMS}")
    parser.add_argument("--fresh", action="store_true", help="measure rows again that are done")
    parser.add_argument("--list", action="store_true", help="name the rows and methods, and measure nothing")
    parser.add_argument("--render", action="store_true", help="write table and pictures again, and measure nothing")
    parser.add_argument("--aria", type=Path, default=ARIA, metavar="FOLDER", help=f"real problems (default: {ARIA})")
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", help="default: benchmarks/results; build/benchmarks for trials"
    )
    chosen = parser.parse_args(argv)
    if chosen.problems is not None and chosen.problems < 1:
        parser.error("--problems takes a number from 1 upwards")
    if chosen.quick and chosen.problems is None:
        chosen.problems = QUICK_PROBLEMS
    if chosen.out is None:
        chosen.out = RESULTS if chosen.problems is None and chosen.method is None else TRIAL_RESULTS
    return chosen


def other_rows(problems: int | None) -> dict[str, tuple[str, Callable[[], Row]]]:
    """Title and measurement of the rows that are no race between pose estimators, by name."""
    small = problems is not None
    checked = min(problems, 200) if problems is not None else 10_000
    return {
        "proven": (
            f"proven optimal, simulation with 0 to 97 % outliers and at least {proven.MIN_RIGHT} right matches",
            lambda: proven.measure(max(proven.COUNTS.values()) if problems is None else problems),
        ),
        "certificate": (
            f"certificate beside brute force, {checked:,} random problems with N <= {certificate.MAX_COUNT}",
            lambda: certificate.measure(checked),
        ),
        "clique": (
            "maximum clique of ball-overlap graphs",
            lambda: clique.measure(clique.GRAPHS[:2] if small else clique.GRAPHS, 2 if small else 5),
        ),
        "memory": ("memory of mc-exact", lambda: memory.measure((500,) if small else (5000, 100_000))),
    }


class Results:
    """The rows in ``results.json``: those of other sources, or of another size, are measured again."""

    def __init__(self, folder: Path, state: str) -> None:
        self.folder, self.state = folder, state
        self.path = folder / "results.json"
        self.rows: dict[str, Row] = {}
        if self.path.is_file():
            self.rows = {row["case"]: row for row in json.loads(self.path.read_text(encoding="utf-8"))["rows"]}

    def done(self, name: str, size: Any) -> bool:
        """Whether a row is there as it would be measured now."""
        row = self.rows.get(name)
        return row is not None and row["state"] == self.state and row["size"] == size

    def add(self, name: str, size: Any, row: Row) -> None:
        """Write a row, whole or not at all."""
        self.rows[name] = {"case": name, "state": self.state, "size": size, "machine": describe(), **row}
        self.folder.mkdir(parents=True, exist_ok=True)
        _replace(self.path, json.dumps({"rows": list(self.rows.values())}, indent=1, ensure_ascii=False) + "\n")
        self.write_table()

    def write_table(self) -> None:
        """The report of what is there."""
        _replace(self.folder / "table.md", markdown(list(self.rows.values())))


def _replace(path: Path, text: str) -> None:
    part = path.with_suffix(path.suffix + ".part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)


def measured_counts(case: Case, methods: dict[str, Method], chosen: argparse.Namespace) -> dict[str, int]:
    """How many problems each method of a case gets in this run."""
    counts = {name: count for name, count in case.counts.items() if name in methods and count > 0}
    if chosen.method is not None:
        counts = {name: count for name, count in counts.items() if name in chosen.method}
    if chosen.problems is not None:
        counts = {name: min(count, chosen.problems) for name, count in counts.items()}
    return counts


def run(chosen: argparse.Namespace) -> int:
    """Measure what is asked for; returns the exit code."""
    from benchmarks.peers import peers, use_one_thread

    use_one_thread()
    methods = our_methods() | peers()
    aria = chosen.aria if chosen.aria.is_absolute() else ROOT / chosen.aria
    cases = {case.name: case for case in [*simulated_cases(), *aria_cases(aria)]}
    others = other_rows(chosen.problems)
    if chosen.list:
        print("rows:   ", *cases, *others, sep="\n  ")
        print("methods:", *methods, sep="\n  ")
        return 0
    for kind, asked, known in (("row", chosen.case, [*cases, *others]), ("method", chosen.method, list(methods))):
        unknown = sorted(set(asked or ()) - set(known))
        if unknown:
            print(f"no {kind} {', '.join(unknown)}: choose from {', '.join(known)}", file=sys.stderr)
            return 2
    results = Results(chosen.out, fingerprint())
    if chosen.render:
        if not results.rows:
            print(f"nothing was measured in {results.folder}", file=sys.stderr)
            return 2
        draw(results)
        return 0
    wanted = chosen.case or [*cases, *([] if chosen.method else others)]
    begin = time.monotonic()
    for name in wanted:
        if name in cases:
            case = cases[name]
            size, title = measured_counts(case, methods, chosen), case.title
        else:
            size, title = chosen.problems, others[name][0]
        print(f"\n[{time.monotonic() - begin:.0f} s] {name}: {title}", flush=True)
        if results.done(name, size) and not chosen.fresh:
            print("  already measured with these sources; --fresh measures it again")
            continue
        if name in cases:
            settings = {method: methods[method].settings for method in size}
            facts = {"kind": "poses", "title": title, "facts": case.facts, "settings": settings}
            results.add(name, size, facts | measure(case, methods, size))
        else:
            results.add(name, size, {"kind": name, "title": title} | others[name][1]())
        print("\n".join("  " + line for line in case_lines(results.rows[name])), flush=True)
    if not any(name.startswith("aria") for name in cases):
        print(f"\nskipped: the real problems, {aria / '*.toml'} not found; name their folder with --aria")
    draw(results)
    return 0


def draw(results: Results) -> None:
    """The table and the pictures of what is there."""
    from benchmarks.pictures import draw_all

    results.write_table()
    for path in (results.folder / "table.md", *draw_all(list(results.rows.values()), results.folder)):
        print(f"wrote {path}")


if __name__ == "__main__":
    restart_on_one_core("benchmarks.run")
    sys.exit(run(arguments(sys.argv[1:])))
