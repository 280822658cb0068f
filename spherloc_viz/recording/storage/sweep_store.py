"""Records the runs of a sweep where they are done: in many processes at once, into one folder and its list."""

import json
import uuid
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from spherloc.errors import RecordingError
from spherloc.experiments.sweep import Job, SweepPlan
from spherloc.trace import Trace
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.storage.leftovers import here
from spherloc_viz.recording.storage.store import RecordingStore, sweep_file_name


@dataclass(frozen=True)
class SweepStore:
    """Keeps the runs of all workers on the machine where it was made; others cannot reach its folder.

    A run that is done again, because its worker was killed or its sweep interrupted, replaces its own recording.
    Nothing is deleted to make room: that is for one process to do, which has a ``RecordingStore``.
    """

    folder: Path
    """Of the recordings, absolute."""
    machine: str = field(default_factory=here)
    """Where it was made."""

    def __call__(self, plan: SweepPlan, job: Job, trace: Trace) -> str:
        """Record a run; returns why that failed, in a sentence."""
        if here() != self.machine:
            return ""
        origin = Origin("sweep", plan.scene, plan.first_seed + job.run, None, plan.variation_at(job.value))
        store, told = _store(self.folder)
        try:
            run_id = sweep_run_id(plan, job)
            store.record(trace, origin, path=self.folder / sweep_file_name(trace, run_id), run_id=str(run_id))
        except RecordingError as error:
            return str(error)
        except Exception as error:  # a bug in drawing one run must not end the sweep
            return f"{plan.place(job)}: the run cannot be recorded: {error!r}."
        sentence = " ".join(told)
        told.clear()
        return sentence


def sweep_run_id(plan: SweepPlan, job: Job) -> uuid.UUID:
    """What tells a run of a sweep from others: a hash of all that decides its result."""
    table = plan.record()
    shared = {name: table[name] for name in ("scene", "scene_sha256", "camera_sha256", "versions")}
    own = {
        "variation": plan.variation_at(job.value).simulation,
        "estimator": table["entrants"][job.entrant],
        "seed": plan.first_seed + job.run,
    }
    return uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(shared | own, sort_keys=True))


@lru_cache(maxsize=1)
def _store(folder: Path) -> tuple[RecordingStore, list[str]]:
    """This process's own, and what it has to say."""
    told: list[str] = []
    return RecordingStore(folder, told.append, keep_bytes=None), told
