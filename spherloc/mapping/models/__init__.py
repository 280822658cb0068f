"""Models of many images: made by COLMAP, joined, checked for misplaced images, and kept."""
