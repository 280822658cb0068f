"""The run index at 10,000 runs: every filter, sort order, page and group beside the same in plain Python.

    python -m benchmarks.run_index [--runs 10000] [--repeats 3] [--files 10000] [--folder DIR]

The peer keeps a row a run as JSON, one a line, and reads, filters and sorts them for every question, as a program
without an index would. Times are processor time of the one thread that asks, medians of the repeats, so that a busy
machine does not count. Prints the slowest question of every kind and writes ``results/run_index.json``.

With ``--files`` it measures only how fast a list is made from so many files, in wall time and with the start of the
processes that read them. The files are links to one real recording, which is in the system's memory; with ``--folder``
they are links to all recordings of a folder, as a sweep made it.
"""

import argparse
import json
import os
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import describe
from spherloc.datasets import bundled_scenes, load_scene
from spherloc.diagnosis import Cause
from spherloc.estimators import estimate
from spherloc_viz.given_files import REVIEW_SUFFIX
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.index.query import GROUP_KEYS, OUTCOMES, SORT_KEYS, Range, RunQuery
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.review_file import write_review
from spherloc_viz.recording.reviews import review_path
from spherloc_viz.recording.run_row import RunRow

RESULTS = Path(__file__).parent / "results" / "run_index.json"
LIMIT_MS = 50.0
"""What any filter may take."""
PAGE = 50
THUMBNAIL_BYTES = 2_000
ESTIMATORS = ("mc", "mc-exact", "auto", "ransac-2p", "ransac-epnp", "ransac-mlpnp")
CAMERAS = ("mei", "fisheye", "panorama")
SCENES = tuple(f"scenes/{camera}_outliers_{rate}.toml" for camera in CAMERAS for rate in (50, 80, 90, 95))
SOURCES = ("page", "command", "sweep", "sequence")
WORDS = ("wrong map", "look again", "facade", "night", "seam")
START = datetime(2026, 1, 1, tzinfo=UTC)


def synthetic_row(number: int, rng: np.random.Generator) -> RunRow:
    """A run that never was, with texts as long as those of real runs and a picture that does not compress."""
    scene = SCENES[rng.integers(len(SCENES))]
    estimator = ESTIMATORS[rng.integers(len(ESTIMATORS))]
    cause = list(Cause)[rng.integers(len(Cause))]
    count = int(rng.integers(20, 1000))
    rate = float(rng.uniform(0.3, 0.98))
    inliers = int(count * (1.0 - rate))
    failed = cause is not Cause.OK
    created = START + timedelta(seconds=97 * number)
    name = scene.removeprefix("scenes/").removesuffix(".toml").replace("_", " ")
    labelled = rng.random() < 0.05
    return RunRow(
        file=f"{created:%Y%m%dT%H%M%SZ}_{name.replace(' ', '-')}_{estimator}_{number % 50}_{number:08x}.rrd",
        run_id=f"{number:032x}",
        created=created.isoformat(timespec="milliseconds"),
        source=SOURCES[number % len(SOURCES)],
        scene=scene,
        name=name,
        query=f"left/{number:06d}.jpg" if number % 4 == 3 else None,
        estimator=estimator,
        seed=number % 50,
        options=json.dumps({f"option_{k}": float(rng.uniform()) for k in range(12)}),
        problem_key=f"{number // 6:032x}",
        outcome="unknown" if number % 7 == 0 else "failure" if failed else "success",
        diagnosis=cause.value,
        doubtful=failed,
        summary=f"The pose explains {inliers} of {count} matches: {cause.value}. " + "Look at its steps. " * 5,
        message=f"{inliers} of {count} correspondences agree with one pose; the rest are farther off than the bound.",
        correspondences=count,
        inliers=inliers,
        outlier_rate=rate if number % 9 else None,
        rotation_error_deg=None if number % 7 == 0 else float(rng.exponential(20.0 if failed else 0.2)),
        translation_error_m=None if number % 7 == 0 else float(rng.exponential(2.0 if failed else 0.02)),
        time_ms=float(rng.exponential(30.0)),
        proven=None if estimator != "mc-exact" else bool(rng.random() < 0.8),
        steps=int(rng.integers(8, 60)),
        key_step=4,
        labels=(WORDS[rng.integers(len(WORDS))],) if labelled else (),
        note="Somebody should look at this one again. " * 3 if labelled else "",
        size_bytes=int(rng.integers(300_000, 1_000_000)),
        thumbnail=rng.bytes(THUMBNAIL_BYTES),
        format_version=2,
    )


def questions(rows: list[RunRow]) -> Iterator[tuple[str, RunQuery]]:
    """Every filter with a value that few runs have and one that many have, some together, in every order."""
    many, few = Range(low=0.2), Range(low=0.97, low_open=True)
    middle = rows[len(rows) // 2]
    filters: list[dict[str, Any]] = [{}]
    filters += [{"text": text} for text in ("e", "facade", middle.file, "see pose mei 80", "nowhere")]
    filters += [{"scene": SCENES[0]}, {"scene": "mei_outliers_80"}, {"estimator": "mc"}, {"estimator": "nobody"}]
    filters += [{"outcome": value} for value in OUTCOMES]
    filters += [{"diagnosis": Cause.AMBIGUOUS.value}, {"doubtful": True}, {"label": WORDS[0]}, {"source": "page"}]
    filters += [{"problem_key": middle.problem_key}, {"since": middle.created}, {"until": middle.created}]
    filters += [{"outlier_rate": many}, {"outlier_rate": few}, {"rotation_error_deg": many}, {"time_ms": many}]
    filters += [{"translation_error_m": few}, {"inliers": Range(high=20)}, {"correspondences": Range(100, 900)}]
    filters += [{"outcome": "failure", "outlier_rate": many, "estimator": "mc", "text": "e", "since": rows[9].created}]
    for chosen in filters:
        for sort in SORT_KEYS:
            for descending in (True, False):
                yield " + ".join(chosen) or "everything", RunQuery(**chosen, sort=sort, descending=descending)


def main() -> None:
    """Measure, print, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--files", type=int, default=0)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    if arguments.files or arguments.folder:
        _report_files(_from_files(arguments.files, arguments.folder))
        return
    rng = np.random.default_rng(6)
    rows = [synthetic_row(number, rng) for number in range(arguments.runs)]
    with tempfile.TemporaryDirectory() as folder, RunIndex(Path(folder)) as index:
        seconds = _seconds(lambda: [index.add_all(rows[k : k + 500]) for k in range(0, len(rows), 500)])
        results = {"machine": describe(), "runs": len(rows), "add_a_run_ms": 1e3 * seconds / len(rows)}
        results["one_add_ms"] = _one_add_ms(index, rows[0])
        results["database_mb"] = index.path.stat().st_size / 1e6
        results |= _measured(index, rows, arguments.repeats)
        results["peer"] = _peer(Path(folder), rows, index)
    _report(results)
    if arguments.runs >= 10_000:
        RESULTS.write_text(json.dumps(_rounded(results), indent=1) + "\n", encoding="utf-8")


EXAMINED = 500
"""Files that are read wholly, which takes fifty times as long."""


def _from_files(count: int, real: Path | None) -> dict[str, Any]:
    """Files a second that are listed, and examined: those of the folder ``real``, or so many, half of them labelled."""
    with tempfile.TemporaryDirectory(dir=real) as place:  # links lie on the disk of their files
        folder = Path(place)
        _link_all(folder, real) if real is not None else _link_one(folder, count)
        before, began = _all_processor_s(), time.perf_counter()
        with RunIndex(folder) as index:
            listed = index.refresh()
            listing_s = time.perf_counter() - began
            assert listed.read and not listed.skipped
        processor_ms = 1e3 * (_all_processor_s() - before) / listed.read
        for path in [path for path in folder.iterdir() if not path.name.endswith(REVIEW_SUFFIX)][:-EXAMINED]:
            path.unlink()
        with RunIndex(folder) as index:
            began = time.perf_counter()
            examined = index.examine().read
            examining_s = time.perf_counter() - began
    return {
        "files": listed.read,
        "of": "one recording" if real is None else "a folder",
        "listed_per_s": listed.read / listing_s,
        "listing_processor_ms": processor_ms,
        "examined_per_s": examined / examining_s,
    }


def _link_one(folder: Path, count: int) -> None:
    problem = load_scene(bundled_scenes()["mei_outliers_80"]).problem(0)
    write_recording(estimate(problem, "mc"), folder / "0.rrd")
    write_review(folder / "0.rrd", ["wrong map"], "Look again.")
    for number in range(1, count):
        os.link(folder / "0.rrd", folder / f"{number}.rrd")
        if number % 2:
            os.link(review_path(folder / "0.rrd"), review_path(folder / f"{number}.rrd"))


def _link_all(folder: Path, real: Path) -> None:
    for path in real.glob("*.rrd"):
        os.link(path, folder / path.name)


def _all_processor_s() -> float:
    """Of this process and of those that it started and that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def _report_files(found: dict[str, float]) -> None:
    print(
        f"{found['files']:,.0f} files, links to {found['of']}: listed at {found['listed_per_s']:,.0f} a second "
        f"({found['listing_processor_ms']:.2f} ms of processor time each), "
        f"examined at {found['examined_per_s']:,.0f} a second"
    )
    table = {"machine": describe()} | found
    RESULTS.with_name("run_index_files.json").write_text(json.dumps(_rounded(table), indent=1) + "\n", encoding="utf-8")


def _seconds(work: Callable[[], Any]) -> float:
    """Processor time of ``work``."""
    start = time.thread_time()
    work()
    return time.thread_time() - start


def _one_add_ms(index: RunIndex, row: RunRow) -> float:
    """Median of adding one run in a transaction of its own."""
    times = [1e3 * _seconds(lambda seed=seed: index.add(replace(row, seed=seed))) for seed in range(50)]
    index.add(row)
    return float(np.median(times))


def _measured(index: RunIndex, rows: list[RunRow], repeats: int) -> dict[str, Any]:
    """The slowest question a filter (median of the repeats, ms), on the first and on the last page, and groups."""
    slowest: dict[str, float] = {}
    for name, query in questions(rows):
        last = max(0, (index.find(query, limit=1).total - 1) // PAGE * PAGE)
        for offset in (0, last):
            times = [1e3 * _seconds(lambda q=query, o=offset: index.find(q, PAGE, o)) for _ in range(repeats)]
            slowest[name] = max(slowest.get(name, 0.0), float(np.median(times)))
        if query.sort == "created":
            times = {by: 1e3 * _seconds(lambda q=query, b=by: index.groups(q, b)) for by in GROUP_KEYS}
            slowest["groups"] = max(slowest.get("groups", 0.0), *times.values())
    slowest["oldest successes"] = 1e3 * _seconds(index.oldest_successes)
    slowest["size of all"] = 1e3 * _seconds(index.bytes)
    slowest["one run"] = 1e3 * _seconds(lambda: index.get(rows[-1].file))
    return {"slowest_ms": slowest, "worst_ms": max(slowest.values()), "limit_ms": LIMIT_MS}


def _peer(folder: Path, rows: list[RunRow], index: RunIndex) -> dict[str, float]:
    """One question, "failures with more than 90 % outliers, the worst first", by the index and by reading JSON."""
    path = folder / "rows.jsonl"
    tables = (asdict(row) | {"thumbnail": row.thumbnail.hex()} for row in rows)
    path.write_text("".join(json.dumps(table) + "\n" for table in tables), encoding="utf-8")
    query = RunQuery(outcome="failure", outlier_rate=Range(low=0.9, low_open=True), sort="rotation_error_deg")

    def peer() -> list[str]:
        with path.open(encoding="utf-8") as lines:
            read = [json.loads(line) for line in lines]
        found = [row for row in read if row["outcome"] == "failure" and (row["outlier_rate"] or 0.0) > 0.9]
        found.sort(key=lambda row: (row["rotation_error_deg"], row["file"]), reverse=True)
        return [row["file"] for row in found[:PAGE]]

    assert peer() == [row.file for row in index.find(query, PAGE).rows]
    theirs = float(np.median([1e3 * _seconds(peer) for _ in range(5)]))
    ours = float(np.median([1e3 * _seconds(lambda: index.find(query, PAGE)) for _ in range(5)]))
    return {"json_ms": theirs, "index_ms": ours, "ratio": theirs / ours}


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _rounded(part) for name, part in value.items()}
    return round(value, 3) if isinstance(value, float) else value


def _report(results: dict[str, Any]) -> None:
    print(f"{results['runs']:,} runs, {results['database_mb']:.0f} MB")
    print(f"adding a run: {results['one_add_ms']:.2f} ms; of many at once, {results['add_a_run_ms']:.2f} ms each")
    for name, value in sorted(results["slowest_ms"].items(), key=lambda item: -item[1]):
        print(f"  {value:7.2f} ms  {name}")
    verdict = "within" if results["worst_ms"] <= LIMIT_MS else "ABOVE"
    print(f"the slowest takes {results['worst_ms']:.1f} ms, {verdict} the limit of {LIMIT_MS:.0f} ms")
    peer = results["peer"]
    print(f"one filter: {peer['index_ms']:.2f} ms by the index, {peer['json_ms']:.0f} ms by reading JSON, ", end="")
    print(f"{peer['ratio']:.0f} times as much")


if __name__ == "__main__":
    main()
