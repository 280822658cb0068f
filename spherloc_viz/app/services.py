"""What all pages of one server share."""

from dataclasses import dataclass, field

from spherloc_viz.app.catalog import Catalog
from spherloc_viz.app.touch import TouchDesk
from spherloc_viz.recording.background import Recorder


@dataclass
class Services:
    """Made before the first page connects."""

    catalog: Catalog
    recorder: Recorder | None = None
    """Where settled runs go; None if they are not recorded."""
    desk: TouchDesk = field(default_factory=TouchDesk)
    """Where presses on the pages arrive."""
