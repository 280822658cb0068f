"""What all pages of one server share."""

from dataclasses import dataclass, field
from pathlib import Path

from spherloc_viz.app.catalog import Catalog
from spherloc_viz.app.compilation import Compilation
from spherloc_viz.app.page_runs import Known
from spherloc_viz.app.presented import Presented
from spherloc_viz.app.review.run_library import RunLibrary
from spherloc_viz.app.web.downloads import Downloads
from spherloc_viz.recording.storage.recorder import Recorder


@dataclass
class Services:
    """Made before the first page connects."""

    catalog: Catalog
    roots: tuple[Path, ...] = ()
    """Folders that pages may open scenes from."""
    recorder: Recorder | None = None
    """Where settled runs go; None if they are not recorded."""
    library: RunLibrary | None = None
    """The recordings that pages review; None if there is no folder of them."""
    downloads: Downloads = field(default_factory=Downloads)
    """Files that pages may fetch."""
    presented: Presented = field(default_factory=Presented)
    """What pages of an audience show."""
    first: Known | None = None
    """The recorded run that pages open with; None for the catalog's first scene."""
    compilation: Compilation | None = None
    """Compiles the solvers that are not yet; None if all are ready."""
