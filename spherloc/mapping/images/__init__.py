"""The photographs of a map: which ones, with which cameras, and their lens where no calibration is known."""
