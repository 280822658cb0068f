"""Finds what was localized before in a scene, among the results in a folder."""

from contextlib import suppress
from pathlib import Path

from spherloc.datasets.map_scene import MapScene
from spherloc.errors import InputError
from spherloc.experiments.configuration import read_configuration, scene_sha256
from spherloc.experiments.results import CONFIGURATION, SequenceResults, read_results
from spherloc.experiments.sequence import has_changed
from spherloc.files import is_file, names_in


def kept_results(folder: Path, scene: MapScene, path: Path) -> SequenceResults | None:
    """The newest results in a folder of ``folder`` that are of the scene of the file ``path`` as it is now.

    Rows of queries that have changed since are left out; None if no row is left. Raises ``InputError`` if the scene
    file can no longer be read; results that are damaged are passed over.
    """
    wanted = scene_sha256(scene, path)
    found: list[tuple[float, Path]] = []
    with suppress(InputError):
        for name in names_in(folder):
            file = folder / name / CONFIGURATION
            with suppress(InputError, OSError):
                if is_file(file) and read_configuration(file).scene_sha256 == wanted:
                    found.append((file.stat().st_mtime, folder / name))
    now = {view.name: view for view in scene.queries}
    for _, place in sorted(found, reverse=True):
        with suppress(InputError):
            results = read_results(place)
            rows = tuple(row for row in results.rows if row.query in now and not has_changed(now[row.query], row))
            if rows:
                return SequenceResults(place, results.configuration, rows)
    return None
