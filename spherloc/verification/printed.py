"""Checks the paper's sentences about its own tables against the numbers that are printed in them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spherloc.types import FloatArray
from spherloc.verification.sessions import printed_tables

Found = tuple[bool, str]
"""Whether the table confirms a sentence, and the numbers."""
ALL = "all"
"""Last column of Table III."""


@dataclass(frozen=True)
class Statement:
    """A sentence about a table."""

    place: str
    """Its place in the paper."""
    sentence: str
    """The sentence, in short."""
    check: "Callable[[Tables], Found]"
    """Compares it with the printed numbers."""


class Tables:
    """The printed tables as numbers."""

    def __init__(self, tables: Mapping[str, Any]) -> None:
        self._tables = tables

    def rates(self, key: str, session: str, method: str) -> FloatArray:
        """The numbers of a cell of Tables II (success) to V."""
        if key == "table2":
            return self.numbers(self._row(key, session, method)[2])
        columns = self._tables[key]["columns"]
        row = next(row for row in self._tables[key]["rows"] if row[0] == method)
        return self.numbers(row[columns.index(session)])

    def scores(self, session: str, method: str) -> FloatArray:
        """Time (s), recall, precision and F1 (%) of Table II."""
        return np.array([float(cell) for cell in self._row("table2", session, method)[3:]])

    def methods(self, key: str) -> list[str]:
        """Methods of a table, in its order."""
        place = 1 if key == "table2" else 0
        return list(dict.fromkeys(row[place] for row in self._tables[key]["rows"]))

    def sessions(self, key: str) -> list[str]:
        """Columns of Tables III to V."""
        return [name for name in self._tables[key]["columns"][1:] if name != ALL]

    def cases(self) -> list[list[str]]:
        """Rows of Table VI: case, right of all, method, inliers, errors, time."""
        return self._tables["table6"]["rows"]

    @staticmethod
    def numbers(cell: str) -> FloatArray:
        """The numbers of a cell such as "a / b / c"."""
        return np.array([float(part) for part in cell.split("/")])

    def _row(self, key: str, first: str, second: str) -> list[str]:
        return next(row for row in self._tables[key]["rows"] if row[:2] == [first, second])


def _text(values: FloatArray) -> str:
    return " / ".join(f"{value:g}" for value in values)


def _best_at(session: str, wanted: Mapping[int, str]) -> Callable[[Tables], Found]:
    """The method ``wanted`` has the highest success rate of Table II at each threshold."""

    def found(tables: Tables) -> Found:
        rates = {method: tables.rates("table2", session, method) for method in tables.methods("table2")}
        best = {place: max(rates, key=lambda name: rates[name][place]) for place in wanted}
        return best == dict(wanted), "; ".join(f"{rates[name][place]:g} ({name})" for place, name in best.items())

    return found


def _at_least(key: str, sessions: Sequence[str], better: Sequence[str], worse: Sequence[str]) -> Callable:
    """Each of the first methods is above each of the second ones in all numbers of these sessions."""

    def found(tables: Tables) -> Found:
        short: list[str] = []
        for session in sessions or tables.sessions(key):
            for one in better:
                for other in worse or [name for name in tables.methods(key) if name not in better]:
                    a, b = tables.rates(key, session, one), tables.rates(key, session, other)
                    if not (a > b).all():
                        short.append(f"{session}: {one} {_text(a)}, {other} {_text(b)}")
        return not short, "; ".join(short[:2]) or "in every number"

    return found


def _scores_best(tables: Tables) -> Found:
    short = [
        f"{session}: {name}"
        for session in ("seq1", "seq2")
        for name in tables.methods("table2")
        if (tables.scores(session, name)[1:] > tables.scores(session, "MC")[1:]).any()
    ]
    return not short, "; ".join(short) or "the recall of sequence 1 is 100 for all five"


def _slower(session: str, slow: str, quick: str) -> Callable[[Tables], Found]:
    def found(tables: Tables) -> Found:
        a, b = tables.scores(session, slow)[0], tables.scores(session, quick)[0]
        return bool(a > b), f"{slow} {a:g} s, {quick} {b:g} s"

    return found


def _similar(first: str, second: str, most: float) -> Callable[[Tables], Found]:
    """Two methods of Table III are within ``most`` points of each other over all sessions."""

    def found(tables: Tables) -> Found:
        a, b = tables.rates("table3", ALL, first), tables.rates("table3", ALL, second)
        return bool((np.abs(a - b) <= most).all()), f"{first} {_text(a)}, {second} {_text(b)}"

    return found


def _above_over_all(one: str, others: Sequence[str]) -> Callable[[Tables], Found]:
    def found(tables: Tables) -> Found:
        rates = {name: tables.rates("table3", ALL, name) for name in (one, *others)}
        holds = all((rates[one] > rates[other]).all() for other in others)
        return holds, "; ".join(f"{name} {_text(values)}" for name, values in rates.items())

    return found


def _tenfold(tables: Tables) -> Found:
    mc, ransac = tables.rates("table3", "session00", "MC")[0], tables.rates("table3", "session00", "2P100")[0]
    return bool(
        mc / ransac >= 10.0
    ), f"{mc:g} against {ransac:g} at 0.4 m; {_text(tables.rates('table3', ALL, 'MC'))} over all"


def _all_is_a_mean(tables: Tables) -> Found:
    """Whether "all" is the mean of the sessions for every method."""
    off: list[str] = []
    for method in tables.methods("table3"):
        mean = np.mean([tables.rates("table3", session, method) for session in tables.sessions("table3")], axis=0)
        printed = tables.rates("table3", ALL, method)
        off += [
            f"{method}: the sessions give {a:.2f}, printed is {b:g}"
            for a, b in zip(mean, printed, strict=True)
            if abs(a - b) > 0.1
        ]
    words = "; both agree with 1.3 for 0.3 (session04) and 2.7 for 0.7 (session06)" if off else ""
    return not off, "; ".join(off) + words


def _scores_lead(sessions: Sequence[str], places: Sequence[int]) -> Callable[[Tables], Found]:
    """MC leads Table V in these of recall, precision and F1."""

    def found(tables: Tables) -> Found:
        rivals = [name for name in tables.methods("table5") if name != "MC"]
        short: list[str] = []
        for session in sessions or tables.sessions("table5"):
            mc = tables.rates("table5", session, "MC")
            for name in rivals:
                other = tables.rates("table5", session, name)
                short += [f"{session}: {name} {_text(other)}" for place in places if not mc[place] > other[place]]
        return not short, "; ".join(short) or "in every number"

    return found


def _precise(tables: Tables) -> Found:
    """MC has the highest precision in each case of Table VI."""
    short: list[str] = []
    for case in ("1", "2", "3"):
        counts = {row[2]: tables.numbers(row[3]) for row in tables.cases() if row[0] == case}
        rates = {name: right / everything for name, (right, everything) in counts.items()}
        best = max(rates, key=lambda name: rates[name])
        if rates[best] > rates["MC"]:
            short.append(f"case {case}: MC {100 * rates['MC']:.0f} %, {best} {100 * rates[best]:.0f} %")
    return not short, "; ".join(short)


def _no_more_than_there_are(tables: Tables) -> Found:
    """True positives of Table VI are no more than the right matches."""
    off = [
        f"case {row[0]}: {row[2]} has {row[3]}, of {row[1]}"
        for row in tables.cases()
        if tables.numbers(row[3])[0] > float(row[1].split()[0])
    ]
    return not off, "; ".join(off)


def _slowest(tables: Tables) -> Found:
    times: list[str] = []
    holds = True
    for case in ("1", "2", "3"):
        rows = {row[2]: float(row[6]) for row in tables.cases() if row[0] == case and row[6] != "-"}
        holds &= max(rows, key=lambda name: rows[name]) == "ML10k" and rows["2P10k"] > rows["MC"]
        times.append(f"ML10k {rows['ML10k']:g} s, 2P10k {rows['2P10k']:g} s, MC {rows['MC']:g} s")
    return holds, "; ".join(times)


def _five_hertz(tables: Tables) -> Found:
    times = [float(row[6]) for row in tables.cases() if row[2] == "MC"]
    times += [tables.scores(session, "MC")[0] for session in ("seq1", "seq2")]
    return max(times) <= 0.2, f"{min(times):g} to {max(times):g} s: {1 / max(times):.1f} to {1 / min(times):.0f} Hz"


QUAD, MATH = ("quad-easy", "quad-hard"), ("math-medium", "math-hard")
STATEMENTS: Sequence[Statement] = (
    Statement(
        "VI-B.1, Table II",
        "In sequence 1 MC has the highest success at 0.5 and 2 m, 2P1k at 1 m.",
        _best_at("seq1", {0: "MC", 1: "2P1k", 2: "MC"}),
    ),
    Statement(
        "VI-B.1, Table II",
        "In sequence 2 MC is best at most thresholds, 2P1k at 2 m.",
        _best_at("seq2", {0: "MC", 1: "MC", 2: "2P1k"}),
    ),
    Statement(
        "VI-B.1, Table II", "MC takes less time in sequence 2; 2P1k takes more than MC.", _slower("seq2", "2P1k", "MC")
    ),
    Statement("VI-A.2, Table II", "SVD takes more time than 2P.", _slower("seq1", "SVD100", "2P100")),
    Statement("VI-A.2, Table II", "MLPnP takes more time than 2P.", _slower("seq1", "ML100", "2P100")),
    Statement("VI-B.1, Table II", "MC has the highest recall, precision and F1 in both sequences.", _scores_best),
    Statement(
        "VI-B.2, Table III",
        "All RANSAC methods perform similarly (within 2 points; SVD100 and 2P1k).",
        _similar("SVD100", "2P1k", 2.0),
    ),
    Statement("VI-B.2, Table III", "2P100 performs similarly to ML100.", _similar("2P100", "ML100", 1.0)),
    Statement(
        "VI-B.2, Table III",
        "2P1k slightly outperforms both 2P100 and ML100.",
        _above_over_all("2P1k", ("2P100", "ML100")),
    ),
    Statement(
        "VI-B.2, Table III", "MC is above every RANSAC method in every session.", _at_least("table3", (), ("MC",), ())
    ),
    Statement("VI-B.2, Table III", "A tenfold improvement (session00).", _tenfold),
    Statement("Table III", '"ALL" is the mean of the seven sessions.', _all_is_a_mean),
    Statement("VI-B.3, Table IV", "MC outperforms all other methods on quad.", _at_least("table4", QUAD, ("MC",), ())),
    Statement("VI-B.3, Table IV", "MC outperforms all other methods on math.", _at_least("table4", MATH, ("MC",), ())),
    Statement(
        "VI-B.3, Table IV",
        "2P100, 2P1k and EProPNP are better than oDLT on quad.",
        _at_least("table4", QUAD, ("2P100", "2P1k", "EProPNP"), ("R+oDLT",)),
    ),
    Statement(
        "VI-B.3, Table IV",
        "The same of R+EPro in the place of EProPNP.",
        _at_least("table4", QUAD, ("2P100", "2P1k", "R+EPro"), ("R+oDLT",)),
    ),
    Statement("VI-B.3, Table IV", "2P100 is better than EPnP.", _at_least("table4", (), ("2P100",), ("R+EPnP",))),
    Statement(
        "VI-B.3, Table IV",
        "2P100 and 2P1k are higher than SVD100 and ML100 on math.",
        _at_least("table4", MATH, ("2P100", "2P1k"), ("SVD100", "ML100")),
    ),
    Statement(
        "VI-B.3, Table IV",
        "oDLT is superior to MLPnP on math, and inferior to 2P and (R+)EPro.",
        lambda tables: (
            _at_least("table4", MATH, ("R+oDLT",), ("ML100",))(tables)[0]
            and _at_least("table4", MATH, ("2P100", "2P1k", "R+EPro"), ("R+oDLT",))(tables)[0],
            "as printed for R+EPro; EProPNP alone is below oDLT in every number",
        ),
    ),
    Statement("VI-B.3, Table V", "MC has the best F1 in all sessions.", _scores_lead((), (2,))),
    Statement(
        "VI-B.3, Table V",
        "On quad-easy and math-medium MC leads in all three scores.",
        _scores_lead(("quad-easy", "math-medium"), (0, 1, 2)),
    ),
    Statement("VI-B.3, Table VI", "MC has the highest precision in the three cases.", _precise),
    Statement("VI-A.3, Table VI", "MLPnP is slowest at 10,000 samples, and MC quicker than 2P10k.", _slowest),
    Statement("Table VI", "Right inliers are no more than the right matches.", _no_more_than_there_are),
    Statement("VI-C.3, Tables II, VI", "MC localizes at about 5 Hz.", _five_hertz),
)
"""All statements, in the paper's order."""


def printed_findings() -> list[tuple[Statement, bool, str]]:
    """Each statement, whether the tables confirm it, and the numbers."""
    tables = Tables(printed_tables())
    return [(statement, *statement.check(tables)) for statement in STATEMENTS]
