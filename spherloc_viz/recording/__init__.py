"""Runs as Rerun recordings: written in the background, read back bit for bit, opened in the viewer."""
