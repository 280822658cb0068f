"""All queries of a scene in the background of a page."""

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import pytest
import viser

from spherloc.experiments.results import QueryResult
from spherloc_viz.app.controls import sequence_panel
from spherloc_viz.app.controls.sequence_panel import START, SequencePanel
from spherloc_viz.app.web.touch import Touches
from spherloc_viz.app.web.viser_internals import start_viser, stop_viser
from tests.waiting import until


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    server = start_viser("a key of this test")
    yield server
    stop_viser(server)


def test_what_is_tried_anew_is_told_apart_from_what_is_localized_first(
    server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that a query keeps one recording."""
    rows = [QueryResult(k, name, "localized") for k, name in enumerate("ab")]
    queries = tuple(SimpleNamespace(name=row.query) for row in rows)
    scene = SimpleNamespace(queries=queries, thresholds=((5.0, 0.5),), metric=True, about_truth="")
    told: list[tuple[object, bool]] = []
    monkeypatch.setattr(sequence_panel, "localize_queries", lambda *how: ((row, f"first {row.query}") for row in rows))
    monkeypatch.setattr(
        sequence_panel, "judged_together", lambda *how: iter([(replace(rows[1], inliers=9), "second b")])
    )
    panel = SequencePanel(
        server.gui,
        Touches(lambda error: None),
        None,
        lambda: ("rooms", scene, "mc", None, 0),  # type: ignore[arg-type, return-value]
        lambda trace, anew: told.append((trace, anew)),
        lambda name: None,
    )
    panel._press(None)  # type: ignore[arg-type]
    until(lambda: len(told) == 3 and panel._button.label == START)
    assert told == [("first a", False), ("first b", False), ("second b", True)]
    assert [row.inliers for row in panel.rows("rooms")] == [None, 9]
    panel.close()
