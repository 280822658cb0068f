"""Sends a selection of recordings to the browser as a zip file."""

from collections.abc import Callable
from datetime import UTC, datetime

import viser

from spherloc_viz.app.panels.errand import Errand
from spherloc_viz.app.review import words
from spherloc_viz.app.review.bundle import MOST_RUNS, bundle
from spherloc_viz.app.review.run_list import RunList
from spherloc_viz.app.review.shelf import Shelf
from spherloc_viz.app.web.touch import Touches


class Exporter:
    """Packs what is marked or, if nothing is, the whole list."""

    def __init__(
        self,
        client: viser.ClientHandle,
        touches: Touches,
        shelf: Shelf,
        runs: RunList,
        say: Callable[[str], None],
        complain: Callable[[str], None],
    ) -> None:
        self._client, self._shelf, self._runs, self._say = client, shelf, runs, say
        self._closed = False
        self._errand = Errand(f"spherloc-zip-{client.client_id}", complain)
        touches.on("runs-export", lambda touch: self._errand.ask(self._export))

    def close(self) -> None:
        """Export nothing more; does not wait."""
        self._closed = True
        self._errand.close()

    def _export(self) -> None:
        marked = self._runs.marked
        if marked:
            rows, total = self._shelf.rows(marked[:MOST_RUNS]), len(marked)
        else:
            found = self._shelf.all(self._runs.look, MOST_RUNS)
            rows, total = found.rows, found.total
        about = sum(row.size_bytes for row in rows)
        self._say(f"Packing {len(rows):,} runs, {words.size(about)} …")
        now = datetime.now(UTC)
        packed = bundle(self._shelf.folder, rows, total, now, lambda: self._closed)
        name = f"spherloc-runs-{now:%Y%m%dT%H%M%SZ}.zip"
        self._client.send_file_download(name, packed.content, save_immediately=True)
        self._say(f"{name}: {packed.sentence}")
