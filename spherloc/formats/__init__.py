"""Readers of the files of other tools and datasets; they know nothing of scenes."""
