"""Scenes and the localization problems that they give."""

from spherloc.datasets.scene_file import Scene, bundled_scenes, load_scene, scene_path

__all__ = ["Scene", "bundled_scenes", "load_scene", "scene_path"]
