"""How a recording opens: its blueprint, and the call that puts the blueprint into the recording's own file."""

import subprocess
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from spherloc_viz.layers.primitives import Chart, Picture
from spherloc_viz.recording.columns import TIMELINE
from spherloc_viz.recording.drawing import chart_path
from spherloc_viz.recording.rerun_program import rerun_command, rerun_environment

APPLICATION_ID = "spherloc"
EYE = (1.3, -1.4, -1.8)
"""Where one looks from, in the frame in which the scene has radius 1: from the same side as the page's overview."""
LAYOUT_ROOM = 1 << 20
"""Bytes, many more than a layout takes."""
MERGE_LIMIT_S = 60.0
"""A merge takes 0.02 s; one that takes this long has got stuck."""

ChartLabels = tuple[tuple[str, str], ...]
"""Name and heading of every chart of a recording."""


def chart_labels(pictures: Sequence[Picture]) -> ChartLabels:
    """The charts that a run shows at any step, in the order of their first appearance."""
    charts: dict[str, Chart] = {}
    for picture in pictures:
        for chart in picture.charts:
            charts.setdefault(chart.name, chart)
    return tuple((name, f"{chart.title}: {chart.y_label} over {chart.x_label}") for name, chart in charts.items())


def table_names(pictures: Sequence[Picture]) -> tuple[str, ...]:
    """The tables that a run shows before its last step; those of the last one are part of the outcome."""
    return tuple(dict.fromkeys(table.name for picture in pictures[:-1] for table in picture.tables))


def blueprint(charts: ChartLabels, tables: tuple[str, ...]) -> rrb.Blueprint:
    """The scene on the left, what the step says and its charts on the right, paused at the first step."""
    eye = rrb.EyeControls3D(position=EYE, look_target=(0.0, 0.0, 0.0), eye_up=(0.0, -1.0, 0.0))
    scene = rrb.Spatial3DView(origin="/", contents="/scene/**", name="Scene", eye_controls=eye)
    plots = [rrb.BarChartView(origin=chart_path(name), name=label) for name, label in charts]
    texts = [rrb.TextDocumentView(origin="/outcome", name="Outcome")]
    texts += [rrb.TextDocumentView(origin=rr.new_entity_path(["tables", name]), name=name) for name in tables]
    side = [rrb.TextDocumentView(origin="/step", name="Step"), *plots, rrb.Tabs(*texts)]
    return rrb.Blueprint(
        rrb.Horizontal(scene, rrb.Vertical(*side, row_shares=[1.3] + [1] * len(plots) + [1.3]), column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="paused"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


@cache
def layout_file(charts: ChartLabels, tables: tuple[str, ...]) -> bytes:
    """The blueprint as the bytes of an ``.rbl`` file.

    Kept, since rerun leaves two threads behind for every blueprint that it saves, and runs share few layouts.
    Raises ``OSError`` if it cannot be saved.
    """
    with tempfile.TemporaryDirectory(prefix="spherloc-") as folder:
        path = Path(folder) / "layout.rbl"
        # On a full disk, saving a blueprint would wait for ever: find that out first.
        path.write_bytes(bytes(LAYOUT_ROOM))
        path.unlink()
        blueprint(charts, tables).save(APPLICATION_ID, path)
        return path.read_bytes()


def with_layout(recording: Path, layout: bytes) -> bytes:
    """The recording and its layout as the bytes of one ``.rrd`` file, so that any viewer opens it that way.

    rerun's own program does it: a file's index covers all its stores, so that files cannot just be put end to end.
    Raises ``OSError`` or ``subprocess.SubprocessError`` if the program cannot be run or fails.
    """
    path = recording.with_suffix(".rbl")
    path.write_bytes(layout)
    merge = [*rerun_command(), "rrd", "merge", str(recording), str(path)]
    # In a session of its own, so that a Ctrl-C meant for us does not spoil the file that is being finished.
    done = subprocess.run(
        merge, capture_output=True, check=True, timeout=MERGE_LIMIT_S, env=rerun_environment(), start_new_session=True
    )
    return done.stdout
