"""Readers of the files of other tools and datasets: what is in them, and nothing of scenes."""
