"""Records the runs of a sweep where they are done: in many processes at once, into one folder and its list."""

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from spherloc.errors import RecordingError
from spherloc.experiments.sweep import Job, SweepPlan
from spherloc.trace import Trace
from spherloc_viz.recording.keeping.keeper import Keeper
from spherloc_viz.recording.keeping.leftovers import here
from spherloc_viz.recording.origin import Origin


@dataclass(frozen=True)
class SweepKeeper:
    """Keeps the runs of all workers on the machine where it was made; others cannot reach its folder.

    Nothing is deleted to make room: that is for one process to do, which has a ``Keeper``.
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
        keeper, told = _keeper(self.folder)
        try:
            keeper.record(trace, origin)
        except RecordingError as error:
            return str(error)
        except Exception as error:  # a bug in drawing one run must not end the sweep
            return f"{plan.place(job)}: the run cannot be recorded: {error!r}."
        sentence = " ".join(told)
        told.clear()
        return sentence


@lru_cache(maxsize=1)
def _keeper(folder: Path) -> tuple[Keeper, list[str]]:
    """This process's own, and what it has to say."""
    told: list[str] = []
    return Keeper(folder, told.append, keep_bytes=None), told
