"""Sends a selection of recordings to the browser as a zip file."""

import threading
from collections.abc import Callable
from datetime import UTC, datetime
from html import escape

import viser

from spherloc.errors import RecordingError
from spherloc_viz.app.background_worker import BackgroundWorker
from spherloc_viz.app.review import words
from spherloc_viz.app.review.bundle import MOST_RUNS, bundle
from spherloc_viz.app.review.run_library import RunLibrary
from spherloc_viz.app.review.run_list import RunList
from spherloc_viz.app.text import box
from spherloc_viz.app.web.downloads import Download, Downloads
from spherloc_viz.app.web.touch import Touches


class Exporter:
    """Packs what is marked or, if nothing is, the whole list."""

    def __init__(
        self,
        gui: viser.GuiApi,
        name: str,
        touches: Touches,
        library: RunLibrary,
        downloads: Downloads,
        runs: RunList,
        say: Callable[[str], None],
        complain: Callable[[str], None],
    ) -> None:
        """``name`` tells its thread from those of other pages."""
        self._library, self._downloads, self._runs, self._say = library, downloads, runs, say
        self._link = gui.add_html("", visible=False)
        self._offered: Download | None = None
        self._lock = threading.Lock()
        self._closed = False
        self._background = BackgroundWorker(f"spherloc-zip-{name}", complain)
        touches.on("runs-export", lambda touch: self._background.ask(self._export))

    def close(self) -> None:
        """Export nothing more, and offer nothing; does not wait."""
        self._closed = True
        self._background.close()
        self._offer(None)

    def _export(self) -> None:
        marked = self._runs.marked
        if marked:
            rows, total = self._library.rows(marked[:MOST_RUNS]), len(marked)
        else:
            found = self._library.all(self._runs.look, MOST_RUNS)
            rows, total = found.rows, found.total
        self._offer(None)
        about = sum(row.size_bytes for row in rows)
        self._say(f"Packing {len(rows):,} runs, {words.size(about)} …")
        now = datetime.now(UTC)
        download = self._downloads.room(f"spherloc-runs-{now:%Y%m%dT%H%M%SZ}.zip")
        try:
            packed = bundle(download.path, self._library.folder, rows, total, now, lambda: self._closed)
        except RecordingError:
            self._downloads.withdraw(download)
            raise
        self._offer(download)
        self._say(f"{download.name}: {packed.sentence}")

    def _offer(self, download: Download | None) -> None:
        """Serve this file and not the one before; the page fetches it by itself once."""
        with self._lock:
            if self._offered is not None:
                self._downloads.withdraw(self._offered)
            self._offered = download
            if download is not None and not self._closed:
                self._downloads.offer(download)
            elif download is not None:
                self._downloads.withdraw(download)
        if self._closed:
            return
        if download is not None:
            link = f'<a data-fetch href="{escape(download.address)}" download>{escape(download.name)}</a>'
            self._link.content = box(f"Your browser saves it; if it does not: {link}", "font-size:12px")
        self._link.visible = download is not None
