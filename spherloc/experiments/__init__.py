"""Experiments on many problems: a query sequence against a map, its errors and its success rates."""

from spherloc.experiments.results import SequenceResults, read_results
from spherloc.experiments.rows import QueryResult

__all__ = ["QueryResult", "SequenceResults", "read_results"]
