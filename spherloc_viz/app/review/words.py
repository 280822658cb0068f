"""A recorded run's numbers in short words."""

import json
from datetime import UTC, datetime

from spherloc_viz import style
from spherloc_viz.layers.frame import angle_text, length
from spherloc_viz.recording.run_row import RunRow

UNKNOWN = "–"
UNTOLD_TITLE = "A run"
COLORS = {"success": style.INLIER, "failure": style.OUTLIER, "unknown": style.UNDECIDED}
"""Colours of outcomes."""


def title_of(row: RunRow) -> str:
    """What the run is called: a curated case's title, else the problem and its query image."""
    name = row.title or row.name or row.file
    return f"{name}, {row.query}" if row.query and row.query not in name else name


def untold_title_of(row: RunRow) -> str:
    """What the run is called where no answers are told: a case's title is one, and the name of a problem may be."""
    return row.query or UNTOLD_TITLE


def percent(share: float | None) -> str:
    """A share of wrong matches."""
    return UNKNOWN if share is None else f"{100.0 * share:.3g} %"


def angle(degrees: float | None) -> str:
    """A rotation error."""
    return UNKNOWN if degrees is None else angle_text(degrees)


def distance(metres: float | None, metric: bool | None) -> str:
    """A position error; if it is known not to be ``metric``, in units of the map."""
    return UNKNOWN if metres is None else length(metres, metric is not False)


def errors(row: RunRow) -> str:
    """Both errors of a run's pose."""
    return f"{angle(row.rotation_error_deg)} · {distance(row.translation_error_m, row.metric)}"


def duration(ms: float) -> str:
    """A run's time."""
    return f"{ms:.3g} ms" if ms < 1000.0 else f"{ms / 1000.0:.3g} s"


def size(count: int) -> str:
    """A number of bytes."""
    return f"{count / 1e6:.3g} MB" if count >= 1e5 else f"{count / 1e3:.3g} kB"


def moment(created: str, now: datetime) -> str:
    """When a run was made, on this machine's clock: the time of today's, the day of others; ``now`` has a zone."""
    try:
        when = datetime.fromisoformat(created).astimezone(now.tzinfo)
    except ValueError:
        return ""
    if when.date() == now.date():
        return f"{when:%H:%M:%S}"
    return f"{when:%d %b}" if when.year == now.year else f"{when:%d %b %Y}"


def clock(created: str) -> str:
    """When a run was made, to the second."""
    try:
        return f"{datetime.fromisoformat(created).astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC"
    except ValueError:
        return ""


def options_of(row: RunRow) -> dict[str, str]:
    """The run's options as texts; none if they cannot be read."""
    try:
        values = json.loads(row.options)
    except (ValueError, RecursionError):
        return {}
    return {str(name): str(value) for name, value in values.items()} if isinstance(values, dict) else {}
