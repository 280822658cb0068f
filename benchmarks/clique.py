"""Maximum clique of ball-overlap graphs: ours beside NetworKit and networkx on the same graphs.

NetworKit cannot be interrupted and may take minutes on a dense graph, so each library has a process of its own, with a
time limit for all its graphs.
"""

import multiprocessing
import signal
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.max_clique import max_clique
from spherloc.consensus.translation_balls import overlapping

Graph = NDArray[np.bool_]

GRAPHS = ((500, 0.05, 100), (500, 0.2, 100), (2000, 0.05, 100), (2000, 0.2, 300))
"""Balls, share of the pairs that overlap by chance, and planted balls that all overlap."""
BRANCHES = 50_000_000
"""Ours may search on where the program would stop and report what is not proven."""
LIMIT_S = 60.0


def ball_graph(count: int, density: float, planted: int, seed: int) -> Graph:
    """Adjacency (count, count) of balls of which ``planted`` share a point and the rest lie anywhere in a cube."""
    rng = np.random.default_rng([seed, count, planted])
    sides = rng.uniform(-5.0, 5.0, (count, 3))
    shapes = rng.uniform(0.5, 1.5, count)
    low, high = 0.0, 10.0
    for _ in range(30):  # radii that give the density
        radius = 0.5 * (low + high)
        share = float(np.mean(overlapping(sides[planted:], radius * shapes[planted:])))
        low, high = (radius, high) if share < density else (low, radius)
    radii = low * shapes
    towards = rng.standard_normal((planted, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    sides[:planted] = towards * (rng.uniform(0.0, 1.0, planted) * radii[:planted])[:, None]
    order = rng.permutation(count)
    graph = overlapping(sides[order], radii[order])
    return graph | graph.T


def _ours(graph: Graph) -> Callable[[], Iterable[int]]:
    return lambda: max_clique(graph, BRANCHES).nodes


def _networkit(graph: Graph) -> Callable[[], Iterable[int]]:
    import networkit

    networkit.setNumberOfThreads(1)
    rows, columns = (np.ascontiguousarray(ends, dtype=np.uint64) for ends in np.nonzero(np.triu(graph, 1)))
    converted = networkit.GraphFromCoo((rows, columns), n=len(graph))

    def solve() -> Iterable[int]:
        search = networkit.clique.MaximalCliques(converted, maximumOnly=True)
        search.run()
        return search.getCliques()[0]

    return solve


def _networkx(graph: Graph) -> Callable[[], Iterable[int]]:
    import networkx

    converted = networkx.from_numpy_array(np.triu(graph, 1))
    # None counts nodes, as networkx documents; its annotation forgets it.
    return lambda: networkx.max_weight_clique(converted, weight=None)[0]  # pyright: ignore[reportArgumentType]


LIBRARIES = {"spherloc": _ours, "NetworKit": _networkit, "networkx": _networkx}


def _work(library: str, problem: tuple[int, float, int], repeats: int, pipe: Any) -> None:
    """Sizes and times (ms) of the cliques of ``repeats`` graphs; building a library's graph is not timed."""
    LIBRARIES[library](ball_graph(60, 0.2, 10, 0))()
    for seed in range(repeats):
        graph = ball_graph(*problem, seed)
        solve = LIBRARIES[library](graph)
        start = time.perf_counter()
        nodes = np.fromiter(solve(), np.int64)
        elapsed_ms = 1e3 * (time.perf_counter() - start)
        inside = graph[np.ix_(nodes, nodes)].copy()
        np.fill_diagonal(inside, True)
        pipe.send((len(nodes), elapsed_ms, bool(inside.all())))
    pipe.close()


def run_library(library: str, problem: tuple[int, float, int], repeats: int, limit_s: float) -> dict[str, Any]:
    """Sizes, median time and whether every answer was a clique, of the graphs done within the limit."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(library, problem, repeats, theirs), daemon=True)
    process.start()
    theirs.close()
    deadline, answers = time.monotonic() + limit_s, []
    try:
        while ours.poll(max(0.0, deadline - time.monotonic())):
            answers.append(ours.recv())
        process.terminate()
    except EOFError:  # it is done
        pass
    process.join()
    if process.exitcode not in (0, -signal.SIGTERM):
        raise RuntimeError(f"{library} ended with code {process.exitcode}; its message is above")
    if not answers:
        return {"graphs": 0, "limit_s": limit_s}
    sizes, times_ms, cliques = zip(*answers, strict=True)
    return {
        "graphs": len(sizes),
        "sizes": list(sizes),
        "median_ms": round(float(np.median(times_ms)), 3),
        "cliques": all(cliques),
    }


def measure(graphs: tuple[tuple[int, float, int], ...], repeats: int, limit_s: float = LIMIT_S) -> dict[str, Any]:
    """All libraries on all graphs; says whether those that finished a graph agree on its size."""
    rows = []
    for problem in graphs:
        found = {library: run_library(library, problem, repeats, limit_s) for library in LIBRARIES}
        sizes = [result["sizes"] for result in found.values() if result["graphs"]]
        agree = all(len(set(column)) == 1 for column in zip(*sizes, strict=False))
        rows.append({"balls": problem[0], "density": problem[1], "planted": problem[2], "same_size": agree, **found})
    return {"graphs": rows}
