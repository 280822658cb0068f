"""The commands about recordings; ``spherloc_viz.cli`` registers them."""

from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional


def view(
    recording: Positional[Path],
    /,
    web: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    port: int = 9090,
) -> int:
    """Open a recording in the Rerun viewer, at the timeline of its steps.

    For example:

    spherloc view recordings/20260101T120000Z_street_mc_0_1a2b3c4d.rrd

    spherloc view run.rrd --web

    Args:
        recording: A recording (.rrd).
        web: Serve the viewer to a browser on this machine instead of opening a window.
        port: Port of the web viewer.
    """
    from spherloc_viz.recording.view import view as open_viewer

    open_viewer(recording, web=web, port=port)
    return 0
