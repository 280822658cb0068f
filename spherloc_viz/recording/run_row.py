"""What a list of runs shows about a run: a row of the run index, and the properties of its recording."""

from dataclasses import dataclass

STORED_AS = {"key_step": "decisive_step"}
"""Fields that recordings know by the name that they had in the first format."""
COUNTED_FROM_1 = 4
"""The first format whose timeline counts steps from 1."""


@dataclass(frozen=True)
class RunRow:
    """One recorded run. None stands for what is unknown."""

    file: str
    """Name of its file in the folder of recordings; it names the run."""
    run_id: str
    """Id of the recording in Rerun, which stays the same when the file is renamed."""
    created: str
    """When, ISO 8601 in UTC with milliseconds, so that texts sort by time."""
    source: str
    """Who ran it: page, command, sweep, sequence, gallery or unknown."""
    scene: str
    """Name of its scene file, or a description."""
    name: str
    """Name of the problem."""
    query: str | None
    """Name of the query image, if there is one."""
    estimator: str
    """Registered name."""
    seed: int
    """Seed of the estimator."""
    options: str
    """Its options as JSON; infinity is the text "inf"."""
    problem_key: str
    """Hash of the problem's numbers: two runs with the same one solved the same problem."""
    outcome: str
    """ "success", "failure" or "unknown" (no truth)."""
    diagnosis: str
    """Value of ``spherloc.diagnosis.Cause``; empty if the run was not diagnosed."""
    doubtful: bool | None
    """Whether the diagnosis speaks against the pose."""
    summary: str
    """The diagnosis in one sentence."""
    message: str
    """The outcome in one sentence."""
    correspondences: int
    """N."""
    inliers: int
    """Correspondences within the bound of the estimated pose."""
    outlier_rate: float | None
    """Share of wrong correspondences, 0 to 1: the true one where labels are known, else the front end's estimate."""
    rotation_error_deg: float | None
    """None if there is no truth or no pose."""
    translation_error_m: float | None
    """Between the camera positions, metres, or units of the map if it is not ``metric``."""
    time_ms: float
    """Wall time of the estimator."""
    proven: bool | None
    """Whether the consensus is proven to be the largest; None without a certificate."""
    steps: int
    """Steps on the timeline."""
    key_step: int
    """Index of the step at which the run was decided, or went wrong."""
    changes: str = ""
    """What was changed of the scene, in a few words."""
    residual_median: float | None = None
    """This and what follows, down to ``position_sd_m``: see ``spherloc.diagnosis.Measures``."""
    residual_p90: float | None = None
    alternative_support: float | None = None
    certificate_gap: float | None = None
    tilt_deg: float | None = None
    coverage: float | None = None
    rotation_sd_deg: float | None = None
    position_sd_m: float | None = None
    metric: bool | None = None
    """Whether the map's lengths are metres, else in units of its own; None in older recordings, whose maps were."""
    title: str = ""
    """Title of a curated case."""
    labels: tuple[str, ...] = ()
    """Labels that a reviewer gave to the run."""
    note: str = ""
    """What a reviewer wrote about it."""
    size_bytes: int = 0
    """Size of the file."""
    thumbnail: bytes = b""
    """A small PNG; empty if there is none."""
    format_version: int = 0
    """Format version of the recording."""

    @property
    def unit(self) -> str:
        """Unit of its lengths: "m" or "units"."""
        return "units" if self.metric is False else "m"

    def on_timeline(self, number: int) -> int:
        """Where a step is on the recording's timeline; ``number`` counts from 1, as pages do, and so do timelines of
        the format ``COUNTED_FROM_1`` and later."""
        return number if self.format_version >= COUNTED_FROM_1 else number - 1
