"""The commands about recordings; ``spherloc_viz.cli`` registers them."""

from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional


def view(
    recording: Positional[Path],
    /,
    web: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    step: int | None = None,
    port: int = 9090,
) -> int:
    """Open a recording in the Rerun viewer, paused at the step where the run was decided or went wrong.

    Shows its labels and note too.

    For example:

    spherloc view recordings/20260101T120000Z_street_mc_0_1a2b3c4d.rrd

    spherloc view run.rrd --web --step 3

    Args:
        recording: A recording (.rrd).
        web: Serve the viewer to a browser on this machine instead of opening a window.
        step: The step to open at; 0 is the first, and the decisive one is taken if it is not given.
        port: Port of the web viewer; 0 takes a free one.
    """
    from spherloc_viz.app.web.viewer_server import serve_recording
    from spherloc_viz.recording.strangers import examine
    from spherloc_viz.recording.view import step_of, view_in_window

    row = examine(recording)
    place = step_of(row, step)
    if web:
        serve_recording(recording, row, place, port)
    else:
        view_in_window(recording, place)
    return 0


def repeat(
    recordings: Positional[tuple[Path, ...]],
    /,
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
) -> int:
    """Solve the problem of a recording again, with its estimator, options and seed, and compare.

    The same are a pose that agrees in every bit, the inliers, the certificate and the message. If one differs, it says
    how, whether it is by rounding only, and which versions are not what they were. Ends with 0 if all are the same, 1
    if one differs, 2 if a file is no recording that can be repeated here.

    For example:

    spherloc repeat recordings/20260101T120000Z_street_mc_0_1a2b3c4d.rrd

    spherloc repeat recordings/*_mc_*.rrd --json

    Args:
        recordings: Recordings (.rrd), one or more.
        json: Print one JSON object a recording, on one line; infinity is the text "inf".
    """
    from spherloc_viz.recording.repeat_text import repeat_all

    return repeat_all(recordings, json)
