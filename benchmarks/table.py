"""The results as Markdown, and the series that tables and pictures share."""

import json
from typing import Any

import numpy as np

from benchmarks.cases import ADAPTIVE, GOALS

Row = dict[str, Any]
Series = dict[str, list[tuple[float, dict[str, Any]]]]


def markdown(rows: list[Row]) -> str:
    """The whole report."""
    lines = ["# Benchmarks", "", *_machine_lines(rows), "", *_HOW_TO_READ, ""]
    for row in rows:
        lines += [f"## {row['title']} (`{row['case']}`)", "", *case_lines(row), ""]
    slopes = growth_slopes(rows)
    if slopes:
        lines += ["## Growth with N at 90 % outliers", "", "time ~ N^slope, fitted from the N given", ""]
        lines += ["| method | slope | N |", "|---|---|---|"]
        lines += [f"| {name} | {slope:.2f} | {low:.0f} to {high:.0f} |" for name, (slope, low, high) in slopes.items()]
        lines += [""]
    return "\n".join(lines).rstrip() + "\n"


_HOW_TO_READ = (
    "One thread on one core, all methods in one process on the same problems in turn, each after a problem that is",
    "not counted. Times are medians of the whole call; what a method is given (bearings and their Jacobians for ours,",
    "pixels of a camera that it knows for the peers) is prepared before. The columns `/` are a time divided by that of",
    f"`mc-exact` and of `{ADAPTIVE}`. Unless a row says otherwise: the paper's simulation (Sec. VI-A) with",
    "KITTI-360's fisheye, visible points, 1 px noise, 3 px bound; success is less than 1 degree and 0.1 m; errors are",
    "medians of the successes. Gravity is given to `mc-exact`, `mc`, `auto` and `ransac-2p`, with its bound, and to",
    "`PoseLib up2p`, as if it were exact; no other peer could be told. The largest gap is the most matches by which",
    "the proven bound exceeds what was found. A method that used up its seconds got fewer problems than the others.",
)


def case_lines(row: Row) -> list[str]:
    """A row as a Markdown table."""
    return {
        "poses": _pose_lines,
        "proven": _proven_lines,
        "certificate": _certificate_lines,
        "clique": _clique_lines,
        "memory": _memory_lines,
    }[row["kind"]](row)


_LATER = ("slowest ms", "largest gap")
_POSE_COLUMNS = (
    "method",
    "problems",
    "success",
    "median ms (quartiles)",
    "slowest ms",
    "/ mc-exact",
    "/ ransac-2p",
    "error",
    "proven",
    "largest gap",
    "goal",
)


def _pose_lines(row: Row) -> list[str]:
    methods = row["methods"]
    exact, adaptive = (methods.get(name, {}).get("median_ms") for name in ("mc-exact", ADAPTIVE))
    table: list[tuple[str, ...]] = [_POSE_COLUMNS]
    for name, found in methods.items():
        low, high = found["quartiles_ms"]
        error = (
            f"{found['median_error_deg']:.3f} deg, {1e3 * found['median_error_m']:.1f} mm"
            if "median_error_deg" in found
            else ""
        )
        cells = (
            name,
            found["problems"],
            f"{100 * found['success']:.1f} %",
            f"{_short(found['median_ms'])} ({_short(low)} to {_short(high)})",
            _short(found["slowest_ms"]) if "slowest_ms" in found else "",
            _ratio(found["median_ms"], exact),
            _ratio(found["median_ms"], adaptive),
            error,
            f"{100 * found['proven_optimal']:.1f} %" if "proven_optimal" in found else "",
            found.get("largest_gap", ""),
            GOALS.get((row["case"], name), ""),
        )
        table.append(tuple(str(cell) for cell in cells))
    # Rows of earlier sources lack what was not stored then.
    shown = [k for k, column in enumerate(_POSE_COLUMNS) if column not in _LATER or any(line[k] for line in table[1:])]
    lines = ["| " + " | ".join(cells[k] for k in shown) + " |" for cells in table]
    lines.insert(1, "|" + len(shown) * "---|")
    loops = [
        f" {name}: {_short(found['median_inside_ms'])} of its {_short(found['median_ms'])} ms are inside the library, "
        "the rest is its loop in Python."
        for name, found in row["methods"].items()
        if "median_inside_ms" in found
    ]
    return [*lines, "", f"Preparation of a problem for ours: {_short(row['preparation_ms'])} ms." + "".join(loops)]


def _proven_lines(row: Row) -> list[str]:
    lines = ["| N | outliers | proven | not proven at | largest gap |", "|" + 5 * "---|"]
    for one in row["sizes"]:
        rates = [f"{100 * rate:.0f} %" for rate in one["outlier_rates"]]
        left = [f"{rate}: {n}" for rate, n in zip(rates, one["not_proven_by_rate"], strict=True) if n]
        proven = f"{one['proven']:,} of {one['problems']:,}"
        cells = (f"{one['correspondences']:,}", ", ".join(rates), proven, ", ".join(left), str(one["largest_gap"]))
        lines.append("| " + " | ".join(cells) + " |")
    proven, problems = (sum(one[key] for one in row["sizes"]) for key in ("proven", "problems"))
    return [*lines, "", f"mc-exact, gravity exact: {proven:,} of {problems:,} proven, {100 * proven / problems:.2f} %"]


def _certificate_lines(row: Row) -> list[str]:
    bad, known, level = row["dishonest"], row["proven_optimal"], row["proven_optimal_exact_gravity"]
    return [
        f"- upper bound below what brute force found: **{len(bad)}** of {row['problems']:,}"
        + (f", {row['uncertain_gravity']:,} of these with uncertain gravity" if "uncertain_gravity" in row else "")
        + (f" (seeds {', '.join(map(str, bad[:20]))})" if bad else ""),
        f"- proven optimal: {100 * known:.1f} % ({100 * level:.1f} % where gravity is exact); "
        f"mean gap {row['mean_gap']:.2f}",
        f"- brute force found a better pose than the estimator's own: {row['brute_force_found_more']:,}",
    ]


def _clique_lines(row: Row) -> list[str]:
    lines = [
        "| balls | density | planted | spherloc ms | NetworKit ms | networkx ms | NetworKit / spherloc | same size |",
        "|" + 8 * "---|",
    ]
    for graph in row["graphs"]:
        times = [
            (_short(found["median_ms"]) if found["cliques"] else "no clique")
            if found["graphs"]
            else f"> {found['limit_s']:.0f} s"
            for found in (graph["spherloc"], graph["NetworKit"], graph["networkx"])
        ]
        ratio = _ratio(graph["NetworKit"].get("median_ms"), graph["spherloc"].get("median_ms"))
        what = (graph["balls"], f"{100 * graph['density']:.0f} %", graph["planted"])
        cells = (*what, *times, ratio, "yes" if graph["same_size"] else "**no**")
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return lines


def _memory_lines(row: Row) -> list[str]:
    return [_memory_line(run) for run in row.get("runs", [row])]


def _memory_line(run: Row) -> str:
    if "skipped" in run:
        return f"- skipped: {run['skipped']}"
    gap = run.get("gap")
    proven = "" if gap is None else f", not proven: gap {gap}" if gap else ", proven"
    return (
        f"- {run['estimator']}, N={run['correspondences']:,}, 90 % outliers: peak {run['peak_mb']:,} MB, "
        f"{run['growth_mb']:,} MB more than before the call, {run['time_ms'] / 1e3:.2f} s{proven}"
    )


def _machine_lines(rows: list[Row]) -> list[str]:
    """What the rows were measured on; more than one line if they were not all measured alike."""
    told = {}
    for row in rows:
        machine = row["machine"]
        told.setdefault(json.dumps([machine["cpu"], machine["versions"], row["state"]]), []).append((row, machine))
    lines = []
    for group in told.values():
        machine = group[0][1]
        dates, loads = sorted(each["date"] for _, each in group), [each["load_1min"] for _, each in group]
        versions = ", ".join(f"{name} {number}" for name, number in machine["versions"].items())
        which = "" if len(told) == 1 else f" Rows: {', '.join(row['case'] for row, _ in group)}."
        lines.append(
            f"- {machine['cpu']}, {machine['cores']} cores, {machine['system']}, Python {machine['python']}; "
            f"{versions}. {dates[0]} to {dates[-1]}, load {min(loads)} to {max(loads)}.{which}"
        )
    return lines


def _short(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _ratio(value: float | None, base: float | None) -> str:
    return (
        f"{value / base:.2g}"
        if value and base and value / base < 10
        else f"{value / base:,.0f}"
        if value and base
        else ""
    )


def series(rows: list[Row], along: str, fixed: str, value: float) -> Series:
    """(``along``, summary) of each method, ascending, over the cases where the fact ``fixed`` is ``value``."""
    found: Series = {}
    for row in rows:
        facts = row.get("facts") or {}
        if facts.get(fixed) == value:
            for name, summary in row["methods"].items():
                found.setdefault(name, []).append((facts[along], summary))
    return {name: sorted(points, key=lambda point: point[0]) for name, points in found.items()}


def growth_slopes(rows: list[Row]) -> dict[str, tuple[float, float, float]]:
    """Slope of log time over log N at 90 % outliers, and the smallest and largest N, of each method with three N."""
    slopes = {}
    for name, points in series(rows, "correspondences", "outlier_rate", 0.9).items():
        if len(points) >= 3:
            sizes, times = np.array([(size, found["median_ms"]) for size, found in points]).T
            slope = float(np.polyfit(np.log(sizes), np.log(times), 1)[0])
            slopes[name] = (slope, float(sizes[0]), float(sizes[-1]))
    return slopes
