"""Matches of two images and their relative pose: which pairs surely show the same place."""
