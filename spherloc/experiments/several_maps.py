"""Compares what the same photographs gave in several maps: a place is not sure where another map explains more.

Photographs that could not be joined make maps of their own. In each of them a photograph of another place may find a
room or a facade that looks alike, and nothing in that map speaks against it; a map that has the true place, or both of
the places that look alike, explains more of its matches.
"""

from collections.abc import Sequence

from spherloc.experiments.results import LOCALIZED, POSED, QueryResult, SequenceResults


def outdone(results: Sequence[SequenceResults]) -> list[list[QueryResult]]:
    """For each of several maps, the rows of photographs that are localized in it although another one has a pose with
    more inliers: as doubtful ones, which say so.

    ``results`` are those of the same photographs in each of the maps, by the same estimator.
    """
    most: dict[str, tuple[int, SequenceResults]] = {}
    for one in results:
        for row in one.rows:
            if row.status in POSED and (row.inliers or 0) > most.get(row.query, (0, one))[0]:
                most[row.query] = row.inliers or 0, one
    return [
        [
            _doubted(row, most[row.query][1])
            for row in one.rows
            if row.status == LOCALIZED and (row.inliers or 0) < most[row.query][0]
        ]
        for one in results
    ]


def _doubted(row: QueryResult, better: SequenceResults) -> QueryResult:
    where = better.configuration.scene
    return row.doubted(f"More of its matches agree with a pose in the map of {where}; it may have been taken there.")
