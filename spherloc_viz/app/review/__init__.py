"""Reviewing recordings on the page: the list, the run that is open, comparisons, labels, notes and export."""
