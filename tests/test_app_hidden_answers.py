"""With hidden answers nothing on the page tells what came out, whatever tab is looked at."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from reviewing_pages import Office, Visitor, recorded_twice

from spherloc_viz.app.text import WITHHELD
from spherloc_viz.layers import steps
from tests.waiting import until

TELLING = re.compile(
    r"success|failure\b|doubtful|localized|no pose|>\d+/\d+<|\d inlier|>inlier|>outlier|precision|recall|\bF1\b"
    r"|off the truth|diagnosis|rotation error|position error|right by|estimated pose|iterations ran out|% out<"
    r"|decided|best pose|60 % outliers|60-outliers",
    re.IGNORECASE,
)
TRUE = {"off the truth", "rotation error", "position error", "precision", "recall"}
OTHERS = frozenset({"comparison/mc-exact", "comparison/ransac-2p"})
"""Cameras of other estimators."""
VIEWS = "views:Charts,Compare,Graph,Images,Matches,Recordings,Residuals,Yaw;Residuals;"


@pytest.fixture
def office(tmp_path: Path) -> Iterator[Office]:
    one = Office(tmp_path)
    yield one
    one.close()


def told(visitor: Visitor) -> list[str]:
    """What the page says in all tabs that tells answers, without legends and glossary."""
    gui = visitor.page.handle.gui
    parts = [part for box in list(gui._container_handle_from_uuid.values()) for part in list(box._children.values())]
    shown = [part for part in parts if getattr(part, "visible", True)]
    html = [str(part.content) for part in shown if hasattr(part, "content")]
    chosen = [str(part.options) for part in shown if hasattr(part, "options")]
    texts = [text for text in html + chosen if "maximum clique</span>" not in text and "data-glossary" not in text]
    # What is not read: what a press sends, and addresses.
    read = (re.sub(r'(?:data-touch|data-address|href)="[^"]*"', "", text) for text in texts)
    return [match for text in read for match in TELLING.findall(text)]


def test_no_tab_tells_hidden_answers(office: Office) -> None:
    visitor, _, second = recorded_twice(office)  # of which the second has 60 % of outliers
    session, controls = visitor.session, visitor.session._controls
    visitor.touch(VIEWS)
    visitor.touch("compare:ransac-epnp")
    visitor.page.press(controls.compare._button)
    until(lambda: "diagnosis" in controls.compare._table.content or "success" in controls.compare._table.content)
    visitor.touch(f"run-open:{second}")
    until(lambda: "review-card" in visitor.card._places[0].content and not visitor.opening)
    until(lambda: controls.compare._button.label == "Compare")
    session._display.panels.steps.go("bearings")
    until(lambda: len(told(visitor)) > 10)
    until(lambda: session._display.canvas._painter._names & OTHERS)

    visitor.set(controls.display._hide, True)
    until(lambda: WITHHELD in controls.compare._table.content and visitor.rows.count("touch-row") == 2)
    until(lambda: told(visitor) == [])
    assert not session._display.canvas._painter._names & OTHERS
    # Neither do the titles of steps that are to come, the presets, and who else is drawn.
    timeline = steps(session._run.trace)  # type: ignore[union-attr]
    names = [name.partition("  ")[2] for name in session._display.panels.steps._choice.options]
    assert names == [step.title for step in steps(session._run.trace, told=False)]  # type: ignore[union-attr]
    assert names[-1] == "Outcome" and "Refinement" in names and len(set(names)) < len(timeline)
    assert set(controls._preset.options[1:]) <= {f"Preset {number}" for number in range(1, 20)}
    visitor.touch("recordings:gallery")
    until(lambda: WITHHELD in controls._recordings._withheld.content and controls._recordings._withheld.visible)
    visitor.touch("select:3")
    until(lambda: "Match 3" in session._display.card._html.content)
    assert told(visitor) == []

    visitor.touch("reveal:everything")
    visitor.touch("reveal:outcome")
    until(lambda: len(told(visitor)) > 3)
    assert not TRUE.intersection(word.lower() for word in told(visitor)), "what came out says nothing of the truth"
    visitor.touch("reveal:truth")
    until(lambda: TRUE.intersection(word.lower() for word in told(visitor)))
    visitor.set(controls.display._hide, False)
    visitor.set(controls.display._hide, True)
    until(lambda: told(visitor) == [])
    visitor.set(controls.display._hide, False)
    until(lambda: len(told(visitor)) > 10)

    # The last step tells no more than the others.
    visitor.set(controls.display._hide, True)
    session._display.panels.steps.go("outcome")
    until(lambda: WITHHELD in controls.compare._table.content and session._display.step_key == "outcome")
    until(lambda: told(visitor) == [])
    visitor.touch("reveal:outcome")
    visitor.touch("reveal:truth")
    until(lambda: WITHHELD not in controls.compare._table.content and len(told(visitor)) > 10)
