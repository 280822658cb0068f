"""The Rerun viewer, in a window or a browser."""
