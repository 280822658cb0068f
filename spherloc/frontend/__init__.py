"""From pixels to 2D-3D correspondences: features, retrieval, matching, lifting."""
