"""Finds the matches that come with the bundled scenes: ``python -m scripts.scene_matches``, some minutes.

Run it after a change to how worlds are drawn, or to features, matching or retrieval, and raise ``VERSION`` in
``spherloc/frontend/stored_matches.py`` with it. Pictures come from the cache on disk where they were drawn before.
"""

import sys

from spherloc.datasets import bundled_scenes, load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.frontend.stored_matches import StoredMatches, write_matches


def main() -> None:
    """Write the files of all scenes, or of those that are named."""
    for name, path in bundled_scenes().items():
        scene = load_scene(path)
        if sys.argv[1:] and name not in sys.argv[1:]:
            continue
        if isinstance(scene, MapScene) and isinstance(scene.matcher, StoredMatches):
            stored = scene.matcher
            write_matches(stored.path, stored.key, [(view.name, stored.matcher(view)) for view in scene.queries])
            print(f"{stored.path.name}: {stored.path.stat().st_size / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
