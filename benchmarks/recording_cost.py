"""What a recording costs: processor time and bytes a run, beside the same run logged by rerun's ordinary calls.

    python benchmarks/recording_cost.py [--sizes 100 200 1000] [--runs 20]

Times are of the processor, of this process and of those it starts, as the median over runs. "work" is all that keeping
a run takes: painting, encoding, the file, and its row in the list; of that "paint" is what the layers take. "diagnose"
comes on top where a run was not diagnosed yet. The last line is of a rendered scene, with a query image. The peer logs
the same pictures with ``RecordingStream.log``, a call a primitive and step, and saves the same layout, but neither the
problem nor the result. "left" and "ours" are the threads that all runs of the peer and all of ours have left behind.
"""

import argparse
import resource
import shutil
import statistics
import tempfile
import uuid
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rerun as rr

from spherloc.datasets import bundled_scenes, load_scene
from spherloc.datasets.variation import Variation
from spherloc.diagnosis import diagnose
from spherloc.estimators import estimate
from spherloc.trace import Trace
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.key_step import key_step
from spherloc_viz.layers.primitives import Balls, Label, Mesh, Picture, Points, SceneItem, Segments
from spherloc_viz.recording.content.components import bars
from spherloc_viz.recording.content.drawing import chart_path
from spherloc_viz.recording.content.layout import blueprint, shown_in
from spherloc_viz.recording.content.names import APPLICATION_ID
from spherloc_viz.recording.content.panels import panels_of
from spherloc_viz.recording.content.texts import step_text
from spherloc_viz.recording.content.writer import recorded_steps
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.storage.store import RecordingStore

RUNS = (("mei_outliers_80", "mc"), ("mei_outliers_90", "mc-exact"), ("fisheye_outliers_80", "ransac-2p"))
RENDERED = "apartment_night_panorama", "mc"
"""A run with an image, whose number of matches is given."""


def cpu_s() -> float:
    """Processor time of this process and of the ended ones that it started."""
    return sum(
        usage.ru_utime + usage.ru_stime
        for usage in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def cost_ms(work: Callable[[Trace], object], traces: list[Trace]) -> float:
    """Median cost over runs that were not painted before; the first warms up."""
    costs = []
    for trace in traces:
        start = cpu_s()
        work(trace)
        costs.append(1e3 * (cpu_s() - start))
    return statistics.median(costs[1:])


def largest_mb(folder: Path) -> float:
    """Size of the largest recording in a folder, which is deleted."""
    size = max(path.stat().st_size for path in folder.glob("*.rrd"))
    shutil.rmtree(folder)
    return size / 1e6


def thread_count() -> int:
    """Of this process, those of libraries too."""
    return len(list(Path("/proc/self/task").iterdir()))


def painted(trace: Trace) -> dict[int, Picture]:
    """The pictures of a lean recording."""
    headings = steps(trace)
    return {index: paint(trace, index) for index in recorded_steps(headings, key_step(trace, diagnose(trace)))}


def plainly(trace: Trace, path: Path) -> None:
    """The peer: the same pictures and layout by rerun's ordinary calls."""
    pictures = painted(trace)
    stream = rr.RecordingStream(APPLICATION_ID, recording_id=str(uuid.uuid4()))
    stream.save(path, default_blueprint=blueprint(shown_in(list(pictures.values()), panels_of(trace))))
    for index, picture in pictures.items():
        stream.set_time("step", sequence=index)
        stream.log("step", rr.TextDocument(step_text(picture.step), media_type="text/markdown"))
        for item in picture.scene:
            archetype = plain_item(item)
            if archetype is not None:
                stream.log(["scene", *item.name.split("/")], archetype)
        for chart in picture.charts:
            for curve in chart.curves:
                bar = bars(chart, curve)
                stream.log(
                    chart_path(chart.name, curve.label), rr.BarChart(bar.heights, abscissa=bar.left, widths=bar.widths)
                )
    stream.disconnect()


def plain_item(item: SceneItem) -> rr.AsComponents | None:
    """A primitive as rerun's archetype."""
    match item:
        case Points():
            return rr.Points3D(item.positions, colors=item.colors, radii=item.radius_m)
        case Segments():
            return rr.LineStrips3D(list(item.points), colors=item.colors, radii=-item.width_px / 2)
        case Balls():
            radii = np.repeat(item.radii_m[:, None], 3, axis=1)
            return rr.Ellipsoids3D(half_sizes=radii, centers=item.centers, colors=item.colors, fill_mode="solid")
        case Mesh():
            return rr.Mesh3D(
                vertex_positions=item.vertices, triangle_indices=item.faces, albedo_factor=[*item.color, 255]
            )
        case Label():
            return rr.Points3D(item.position[None], labels=[item.text])
    return None


def measure(scene: str, estimator: str, size: int | None, runs: int, folder: Path) -> None:
    """Print one line."""
    problem = Variation(correspondences=size).problem(load_scene(bundled_scenes()[scene]))
    origin = Origin("command")

    def traces() -> list[Trace]:
        # New ones for every measurement, since the layers keep what they have planned of a run.
        return [estimate(problem, estimator, seed=seed) for seed in range(runs)]

    path = folder / "run.rrd"
    told = diagnose(traces()[0])
    threads = thread_count()
    diagnosing = cost_ms(diagnose, traces())
    painting = cost_ms(lambda trace: [paint(trace, index) for index in recorded_steps(steps(trace), 0)], traces())
    with RecordingStore(folder / "lean", print, keep_bytes=None) as store:
        lean = cost_ms(lambda trace: store.record(trace, origin, told), traces())
    with RecordingStore(folder / "full", print, full=True, keep_bytes=None) as store:
        full = cost_ms(lambda trace: store.record(trace, origin, told), traces())
    lean_mb, full_mb = (largest_mb(folder / name) for name in ("lean", "full"))
    before = thread_count()
    peer = cost_ms(lambda trace: plainly(trace, path), traces()) - diagnosing
    left = thread_count() - before
    print(
        f"{estimator:10} {len(problem):5} {lean:7.1f} {painting:7.1f} {lean_mb:6.2f} {full:8.1f} {full_mb:6.2f} "
        f"{peer:8.1f} {path.stat().st_size / 1e6:6.2f} {peer / lean:6.1f} {left:5} {before - threads:5} "
        f"{diagnosing:9.1f}",
        flush=True,
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[100, 200, 1000])
    parser.add_argument("--runs", type=int, default=20)
    given = parser.parse_args()
    rr.set_strict_mode(True)
    print(
        "estimator      N work ms   paint     MB  full ms     MB  peer ms     MB  ratio  left  ours  diagnose",
        flush=True,
    )
    with tempfile.TemporaryDirectory() as folder:
        for scene, estimator in RUNS:
            for size in given.sizes:
                measure(scene, estimator, size, given.runs, Path(folder))
        measure(*RENDERED, None, given.runs, Path(folder))


if __name__ == "__main__":
    main()
