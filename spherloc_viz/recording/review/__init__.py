"""Labels and notes, in a file beside the run."""
