"""Runs as Rerun recordings: written in the background, read back bit for bit, opened in the viewer."""

REVIEW_SUFFIX = ".review.rrd"
"""Ends the name of a review file, which otherwise is that of its run."""
