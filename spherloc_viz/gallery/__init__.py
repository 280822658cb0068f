"""The gallery: failures worth seeing, each with its story, made anew by one command."""

from spherloc_viz.gallery.case import Beside, GalleryCase, Play
from spherloc_viz.gallery.file import GALLERY, gallery_cases, play_of, staged_path

__all__ = ["GALLERY", "Beside", "GalleryCase", "Play", "gallery_cases", "play_of", "staged_path"]
