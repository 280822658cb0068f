"""Experiments on many problems: a query sequence against a map, its errors and its success rates."""

from spherloc.experiments.results import QueryResult, SequenceResults, read_results

__all__ = ["QueryResult", "SequenceResults", "read_results"]
