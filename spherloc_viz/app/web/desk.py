"""The triage desk behind the front door: its page, the runs as columns, pictures, and what a reviewer does there."""

import asyncio
import gzip
import json
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from aiohttp import web

from spherloc.errors import InputError, RecordingError, SpherlocError, show
from spherloc_viz.app.desk import files
from spherloc_viz.app.desk.columns import READ, columns_json
from spherloc_viz.app.desk.comparison import Pair, causes, compare
from spherloc_viz.app.desk.other_folders import OtherFolders
from spherloc_viz.app.desk.page import desk_page
from spherloc_viz.app.desk.report import comparison_html, number, p_text, summary_html
from spherloc_viz.app.review import words
from spherloc_viz.app.review.rows import DESK
from spherloc_viz.app.review.run_library import RunLibrary
from spherloc_viz.app.web.access import SAFE, SORRY_POLICY, sorry_page
from spherloc_viz.app.web.downloads import Download, Downloads
from spherloc_viz.app.web.viewer import viewer_link
from spherloc_viz.layers.primitives import true_minus
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.row_checks import is_thumbnail

DO = f"{DESK}/do"
"""The only address that takes a POST."""
NO_RUNS = "There are no recordings to look at: start the playground without --no-record."
MAX_BYTES = 32 << 20
"""Largest request, bytes: the names of 100,000 runs take 8 MB."""
MAX_REVIEWED = 500
"""Runs that are labelled by one request; a page sends several."""
MAX_REPORTED = 500
"""Runs of a report, whose pictures make it 10 MB."""
MAX_REPORTS = 20
"""Reports that are kept until the server ends; older ones are deleted."""
COMPRESSION = 1
"""Level of gzip: a higher one takes more time than it saves on a local connection."""


def is_desk(path: str) -> bool:
    """Whether a path is that of the desk."""
    return path == DESK or path.startswith(f"{DESK}/")


class DeskRoom:
    """Answers requests for ``/desk...``, which the front door has checked."""

    def __init__(self, library: RunLibrary, downloads: Downloads, allowed: Sequence[Path] = ()) -> None:
        """``allowed`` are the folders below which recordings may be compared with those of the library."""
        self._library, self._downloads = library, downloads
        self._others = OtherFolders(library.folder, allowed)
        # Threads of its own: reading 100,000 runs takes a second, and the playground's pages must not wait for that.
        self._threads = ThreadPoolExecutor(2, "spherloc-desk")
        self._lock = threading.Lock()
        self._packed: tuple[str, bytes] = ("", b"")
        """The runs as they were last sent, and which state of the list that was."""
        self._offered: list[Download] = []

    async def close(self, app: web.Application) -> None:
        """End its threads; for an application's ``on_cleanup``."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def answer(self, request: web.Request) -> web.StreamResponse:
        """The page itself, data that it shows, or the result of an action that it asks for."""
        given = await request.read() if request.method == "POST" else b""
        try:
            return await asyncio.get_running_loop().run_in_executor(self._threads, self._answer, request, given)
        except SpherlocError as error:
            if request.path.rstrip("/") == DESK:
                headers = SAFE | {"Content-Security-Policy": SORRY_POLICY}
                page = sorry_page(str(error))
                return web.Response(status=404, text=page, content_type="text/html", headers=headers)
            status = 400 if isinstance(error, InputError) else 404
            return web.json_response({"error": str(error)}, status=status, headers=SAFE)

    def _answer(self, request: web.Request, given: bytes) -> web.StreamResponse:
        if request.path == DO:
            return _json(self._do(_told(request, given)))
        match request.path.removeprefix(DESK).strip("/"):
            case "":
                return _page()
            case "runs":
                return self._runs(request)
            case "version":
                return _json({"version": self._version()})
            case "saved":
                folder = self._library.folder
                return _json({"views": files.views(folder), "sets": files.sets(folder)})
            case "folders":
                return _json({"folders": self._others.listed()})
            case "run":
                return _json(self._run(request.query.get("run", "")))
            case "evidence":
                return _json(self._evidence(request.query.get("run", "")))
            case "picture":
                return self._picture(request.query.get("run", ""))
        raise RecordingError("There is nothing here; open /desk.")

    def _version(self) -> str:
        return "-".join(map(str, self._library.version()))

    def _runs(self, request: web.Request) -> web.StreamResponse:
        version = self._version()
        with self._lock:
            if self._packed[0] != version or not self._packed[1]:
                columns, notes = self._library.columns(READ)
                text = columns_json(columns, notes, version)
                self._packed = version, gzip.compress(text.encode(), COMPRESSION, mtime=0)
            packed = self._packed[1]
        headers = SAFE | {"Cache-Control": "no-store", "Vary": "Accept-Encoding"}
        if "gzip" in request.headers.get("Accept-Encoding", ""):
            headers["Content-Encoding"] = "gzip"
        else:
            packed = gzip.decompress(packed)
        return web.Response(body=packed, content_type="application/json", headers=headers)

    def _picture(self, file: str) -> web.StreamResponse:
        picture = self._library.row(file).thumbnail
        if not picture or not is_thumbnail(picture):
            return web.Response(status=204, headers=SAFE)
        return web.Response(body=picture, content_type="image/png", headers=SAFE | {"Cache-Control": "max-age=3600"})

    def _run(self, file: str) -> dict[str, Any]:
        """What a panel shows of a run, from the list alone."""
        row = self._library.row(file)
        errors = (words.angle(row.rotation_error_deg), words.distance(row.translation_error_m, row.metric))
        return {
            "file": row.file,
            "title": words.title_of(row),
            "outcome": row.outcome,
            "diagnosis": row.diagnosis,
            "summary": row.summary,
            "message": row.message,
            "facts": [
                f"{row.inliers:,} of {row.correspondences:,} inliers",
                f"outliers {words.percent(row.outlier_rate)}",
                *([f"{', '.join(errors)} off"] if row.rotation_error_deg is not None else []),
                words.duration(row.time_ms),
                f"{row.estimator}, seed {row.seed}",
                f"{row.source}, {words.clock(row.created)}",
                *([f"changed: {row.changes}"] if row.changes else []),
            ],
            "options": words.options_of(row),
            "labels": list(row.labels),
            "note": row.note,
            "step": row.key_step + 1,
            "steps": row.steps,
            "viewer": viewer_link(row.file, row.key_step + 1),
            "path": str(self._library.folder / row.file),
        }

    def _evidence(self, file: str) -> dict[str, Any]:
        """The sentences of the diagnosis, from the recording."""
        run, _ = self._library.read(file)
        found = run.diagnosis
        return {"evidence": [] if found is None else list(found.evidence), "advice": found.advice if found else ""}

    def _do(self, told: Mapping[str, Any]) -> dict[str, Any]:
        """Do the action that a page asks for; raises ``InputError`` if there is no such action."""
        actions: Mapping[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
            "review": self._review,
            "save_view": self._save_view,
            "delete_view": self._delete_view,
            "save_set": self._save_set,
            "report": self._report,
            "compare": self._compare,
        }
        action = actions.get(_text(told, "do"))
        if action is None:
            raise InputError(f"{show(told.get('do'))}: the desk can do {', '.join(actions)}.")
        return action(told)

    def _review(self, told: Mapping[str, Any]) -> dict[str, Any]:
        """Change labels and notes of some runs; returns those of each before and now, and the errors."""
        changes = told.get("changes")
        if not isinstance(changes, list) or len(changes) > MAX_REVIEWED:
            raise InputError(f"label at most {MAX_REVIEWED} runs with one request.")
        done, failed = [], []
        for change in changes:
            if not isinstance(change, dict):
                raise InputError(f"{show(change)} is not a change of a run's labels.")
            file, note = _text(change, "file"), change.get("note")
            if note is not None and not isinstance(note, str):
                raise InputError(f"{show(note)} is not a note; a note is text.")
            add, remove = _texts(change, "add"), _texts(change, "remove")
            try:
                before, now = self._library.relabel(file, add, remove, note)
            except SpherlocError as error:
                failed.append({"file": file, "error": str(error)})
                continue
            done.append(
                {"file": file, "before": [*before.labels], "noteBefore": before.note}
                | {"labels": [*now.labels], "note": now.note}
            )
        return {"done": done, "failed": failed, "version": self._version()}

    def _save_view(self, told: Mapping[str, Any]) -> dict[str, Any]:
        state = told.get("state")
        if not isinstance(state, dict):
            raise InputError("a view is a table of settings.")
        files.save_view(self._library.folder, _text(told, "name"), state)
        return {"views": files.views(self._library.folder)}

    def _delete_view(self, told: Mapping[str, Any]) -> dict[str, Any]:
        files.delete_view(self._library.folder, _text(told, "name"))
        return {"views": files.views(self._library.folder)}

    def _save_set(self, told: Mapping[str, Any]) -> dict[str, Any]:
        rows = self._library.rows(_texts(told, "files"))
        path = files.save_set(self._library.folder, _text(told, "name"), [row.file for row in rows])
        return {"sets": files.sets(self._library.folder), "path": str(path), "runs": len(rows)}

    def _report(self, told: Mapping[str, Any]) -> dict[str, Any]:
        asked = _texts(told, "files")
        rows = self._library.rows(asked[:MAX_REPORTED])
        if not rows:
            raise InputError("no run is listed, so there is nothing to report.")
        left = len(asked) - len(rows)
        remark = f"The first {MAX_REPORTED} of {len(asked):,} runs." if left else ""
        now = datetime.now(UTC)
        name = f"spherloc-runs-{now:%Y%m%dT%H%M%SZ}.html"
        return {"address": self._offer(name, summary_html(rows, remark, now)), "name": name, "runs": len(rows)}

    def _compare(self, told: Mapping[str, Any]) -> dict[str, Any]:
        before, after = self._side(told, "before"), self._side(told, "after")
        before_name, after_name = _text(told, "before_name")[:200], _text(told, "after_name")[:200]
        found, now = compare(before, after), datetime.now(UTC)
        name = f"spherloc-comparison-{now:%Y%m%dT%H%M%SZ}.html"
        return {
            "pairs": len(found.pairs),
            "judged": found.judged,
            "rightBefore": found.right_before,
            "rightAfter": found.right_after,
            "onlyBefore": found.only_before,
            "onlyAfter": found.only_after,
            "broken": _files(found.broken),
            "mended": _files(found.mended),
            "brokenCauses": causes(found.broken),
            "p": p_text(found.p),
            "changes": [
                [c.title, number(c.before), number(c.after), true_minus(number(c.difference)), p_text(c.p)]
                for c in found.changes
            ],
            "address": self._offer(name, comparison_html(found, before_name, after_name, now)),
            "name": name,
        }

    def _side(self, told: Mapping[str, Any], side: str) -> tuple[RunRow, ...]:
        """The runs of one side: of files, of a set by its name, or of another folder by its place."""
        if f"{side}_folder" in told:
            return self._others.rows(_text(told, f"{side}_folder"))
        if f"{side}_set" in told:
            path = files.set_path(self._library.folder, _text(told, f"{side}_set"))
            return self._library.rows(files.read_set(path))
        return self._library.rows(_texts(told, side))

    def _offer(self, name: str, html: str) -> str:
        download = self._downloads.room(name)
        try:
            download.path.write_text(html, encoding="utf-8")
        except OSError as error:
            self._downloads.withdraw(download)
            reason = error.strerror or error
            raise RecordingError(f"the report cannot be written ({reason}); make room for temporary files.") from error
        self._downloads.offer(download)
        with self._lock:
            self._offered.append(download)
            old, self._offered = self._offered[:-MAX_REPORTS], self._offered[-MAX_REPORTS:]
        for report in old:
            self._downloads.withdraw(report)
        return download.address


def _files(pairs: Sequence[Pair]) -> list[tuple[str, str]]:
    return [(pair.before.file, pair.after.file) for pair in pairs]


def _page() -> web.Response:
    page, policy = desk_page()
    headers = SAFE | {"Content-Security-Policy": policy, "Cache-Control": "no-cache"}
    return web.Response(text=page, content_type="text/html", charset="utf-8", headers=headers)


def _json(answer: Any) -> web.Response:
    return web.json_response(answer, headers=SAFE | {"Cache-Control": "no-store"})


def _told(request: web.Request, given: bytes) -> Mapping[str, Any]:
    """The table that a page sent."""
    if request.content_type != "application/json":
        raise InputError("the desk takes JSON only.")
    try:
        told = json.loads(given)
    except (ValueError, RecursionError):
        raise InputError("the request is not JSON.") from None
    if not isinstance(told, dict):
        raise InputError("the request is not a table (JSON object).")
    return told


def _text(told: Mapping[str, Any], name: str) -> str:
    value = told.get(name)
    if not isinstance(value, str):
        raise InputError(f"{name} is missing, or is not text.")
    return value


def _texts(told: Mapping[str, Any], name: str) -> list[str]:
    values = told.get(name, [])
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise InputError(f"{name} is not a list of texts.")
    return values
