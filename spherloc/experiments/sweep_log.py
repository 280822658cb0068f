"""The CSV of a sweep: each run is written before the next one, and a sweep that was stopped can be continued."""

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from spherloc.errors import InputError, reason, show
from spherloc.experiments.configuration import differences, in_short
from spherloc.experiments.sweep_plan import SweepPlan
from spherloc.experiments.sweep_rows import (
    SweepRow,
    columns,
    csv_line,
    row_line,
    row_of_line,
    rows_text,
    summarize,
    summary_text,
)
from spherloc.files import is_file, lock, read_file, reading, size_of, write_whole

MAX_BYTES = 1_000_000_000
MAX_PLAN_BYTES = 1_000_000
PLAN, SUMMARY, PICTURE = ".plan.json", ".summary.csv", ".png"
"""Endings of the files beside the table."""
_UNCOMPARED = {"scene", "runs"}
"""Keys that may differ: a scene that was moved is the same scene, and more runs add to those that are done."""


class SweepLog:
    """Appends rows to a CSV. Use it as a context manager; one process at a time may have the file.

    Beside ``NAME.csv`` it writes ``NAME.plan.json``, by which a sweep recognizes its own files, and, at the end,
    ``NAME.summary.csv`` and ``NAME.png``.
    """

    def __init__(self, path: Path, plan: SweepPlan) -> None:
        """Start a file or continue one.

        Raises ``InputError`` if it cannot be written, holds the runs of another plan, is damaged, if another process
        writes to it, or if a file beside it has a name that the sweep would write to and is not the sweep's own.
        """
        self.path, self._plan = Path(path), plan
        if self.path.suffix != ".csv":
            raise InputError(f"{self.path}: the table of a sweep ends with .csv; name it so.")
        self.rows: list[SweepRow] = []
        """The rows so far, those of earlier sessions first."""
        self._refuse_others()
        with contextlib.ExitStack() as stack:
            try:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._file = stack.enter_context(self.path.open("ab"))
            except (OSError, ValueError) as error:
                raise InputError(f"{self.path}: cannot be written ({reason(error)}); give another file.") from None
            try:
                lock(self._file.fileno())
            except BlockingIOError:
                raise InputError(f"{self.path}: another sweep writes to it; wait or give another file.") from None
            if os.path.lexists(self.beside(PLAN)):
                self._compare()  # another process may have written it first
            self.write(self.beside(PLAN), (json.dumps(plan.record(), indent=2, allow_nan=False) + "\n").encode())
            self._read()
            self._open = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(OSError):  # a full disk was reported when the rows were appended
            self._open.close()

    @property
    def done(self) -> set[tuple[str, float, int]]:
        """(estimator's label, value, seed) of the rows."""
        return {(row.estimator, row.value, row.seed) for row in self.rows}

    def done_of_plan(self) -> int:
        """Number of the plan's runs that are done; the file may hold more."""
        last = self._plan.first_seed + self._plan.runs
        return sum(row.seed < last for row in self.rows)

    def beside(self, ending: str) -> Path:
        """The path beside the table with another ending: ``NAME.png`` for ".png"."""
        return self.path.with_suffix(ending)

    def append(self, row: SweepRow) -> None:
        """Write a row to the file, before this returns. Raises ``InputError`` if that fails; other rows are kept."""
        with self._writing(self.path):
            self._file.write(row_line(row).encode())
            self._file.flush()
        self.rows.append(row)

    def finish(self) -> None:
        """Write the rows in the order of the plan, and the summary. Raises ``InputError`` if that fails."""
        self.write(self.path, rows_text(self._plan.over, self._plan.labels, self.rows).encode())
        points = summarize(self._plan.labels, self.rows)
        self.write(self.beside(SUMMARY), summary_text(self._plan.over, points).encode())

    def write(self, path: Path, content: bytes) -> None:
        """Write a file so that no reader sees half of it. Raises ``InputError`` if that fails."""
        with self._writing(path):
            write_whole(path, content)

    @contextlib.contextmanager
    def _writing(self, path: Path) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise InputError(
                f"{path}: cannot be written ({reason(error)}); what is done is kept ({len(self.rows)} runs): "
                "make room there and give the same command to go on."
            ) from None

    def _refuse_others(self) -> None:
        """Raise ``InputError`` where a new sweep would write to a file that is not its own; before anything is made."""
        if os.path.lexists(self.beside(PLAN)):
            self._compare()
            # Opening a pipe would wait for a process that reads it.
            if os.path.lexists(self.path) and not is_file(self.path):
                raise InputError(f"{self.path}: is not a regular file; remove it or give another file.")
        elif os.path.lexists(self.path) and not (is_file(self.path) and size_of(self.path) == 0):
            raise InputError(
                f"{self.path}: is not a table of a sweep, or has lost its {self.beside(PLAN).name}; give another file."
            )
        else:
            for path in map(self.beside, (SUMMARY, PICTURE)):
                if os.path.lexists(path):
                    raise InputError(f"{path}: exists already, and the sweep would write to it; give another file.")

    def _compare(self) -> None:
        """Raise ``InputError`` if the plan beside the table is another one."""
        path = self.beside(PLAN)
        found = differences(_read_plan(path), json.loads(json.dumps(self._plan.record())), _UNCOMPARED)
        if found:
            listed = in_short(list(found.values()))
            raise InputError(
                f"{self.path}: holds the runs of another sweep ({listed}, by {path.name}); give another file."
            )

    def _read(self) -> None:
        with reading(self.path, "give another file"):
            content = read_file(self.path, MAX_BYTES)
        whole = content[: content.rfind(b"\n") + 1]
        header = csv_line(columns(self._plan.over))
        lines = whole.decode("utf-8", errors="replace").split("\n")[:-1]
        if lines and lines[0] != header.rstrip("\n"):
            raise InputError(f"{self.path}, line 1: is not the heading of this sweep's table; give another file.")
        for number, line in enumerate(lines[1:], start=2):
            self.rows.append(self._checked(row_of_line(line, place := f"{self.path}, line {number}"), place))
        if len(self.done) < len(self.rows):
            raise InputError(f"{self.path}: holds a run twice; delete one of the two lines, or give another file.")
        with self._writing(self.path):
            os.truncate(self.path, len(whole))  # a line that a killed process left half written
            if not lines:
                self._file.write(header.encode())
                self._file.flush()

    def _checked(self, row: SweepRow, place: str) -> SweepRow:
        plan = self._plan
        if row.estimator not in plan.labels or row.value not in plan.values or row.seed < plan.first_seed:
            raise InputError(
                f"{place}: holds {show(row.estimator)} at {row.value:g}, seed {row.seed}, not a run of this sweep; "
                "delete that line."
            )
        return row


def _read_plan(path: Path) -> dict[str, Any]:
    with reading(path, "give another file for the sweep"):
        content = read_file(path, MAX_PLAN_BYTES)
    try:
        table = json.loads(content.decode("utf-8"))
        if not isinstance(table, dict):
            raise ValueError
    except (ValueError, RecursionError):
        raise InputError(f"{path}: is damaged; give another file for the sweep.") from None
    return table
