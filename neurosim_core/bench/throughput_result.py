"""What `neurosim bench throughput` found; a row that could not be measured says why in place of figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Study = Literal["resolution", "launch", "triangles"]
"""What is varied: the size of the picture, the renders per launch, the triangles of the scene."""

EXACT = "exact"
ADAPTIVE = "adaptive"
RAYS_ALONE = "exact, rays alone"

STAGES = ("physics", "render", "scan", "sort and decode", "copy")
"""Parts of a step that time is split into; what remains is the host's."""


@dataclass(frozen=True, kw_only=True)
class StepRow:
    """Whole steps a second of one setting."""

    study: Study
    mode: str
    """`EXACT`: a render at every step; `RAYS_ALONE`: the same with `RenderConfig.candidate_lists` null;
    `ADAPTIVE`."""
    scene: str
    width: int
    height: int
    instants: int
    """Renders per launch."""
    triangles: int | None = None
    steps_per_s: float | None = None
    """Median of the repetitions [1/s]."""
    slowest_per_s: float | None = None
    fastest_per_s: float | None = None
    renders_per_step: float | None = None
    events_per_step: float | None = None
    real_time_factor: float | None = None
    failure: str = ""


@dataclass(frozen=True, kw_only=True)
class Split:
    """Where the time of a step goes, if the parts follow one another; they add up to the whole."""

    width: int
    height: int
    instants: int
    step_us: float
    """Of a run with nothing overlapped [us]."""
    stages_us: Mapping[str, float]
    """Time per step by the names of `STAGES` [us]."""

    @property
    def host_us(self) -> float:
        """What no part accounts for [us]."""
        return self.step_us - sum(self.stages_us.values())


@dataclass(frozen=True, kw_only=True)
class Part:
    """One part of a step alone, with nothing beside it."""

    name: str
    per_step_us: float | None = None
    bytes_per_step: float | None = None
    """Counted, not measured: every array that the part must read or write, once."""
    rays_per_step: int | None = None
    failure: str = ""

    @property
    def gigabytes_per_s(self) -> float | None:
        """Bytes that it moves a second [GB/s]."""
        if self.per_step_us is None or self.bytes_per_step is None:
            return None
        return 1e-3 * self.bytes_per_step / self.per_step_us

    @property
    def rays_per_s(self) -> float | None:
        """Rays a second."""
        if self.per_step_us is None or self.rays_per_step is None:
            return None
        return 1e6 * self.rays_per_step / self.per_step_us


@dataclass(frozen=True, kw_only=True)
class Roofline:
    """How far a whole step is from its parts alone, and these from what the device can do."""

    width: int
    height: int
    instants: int
    step_us: float | None
    """A whole step of the same size, overlapped as in a run [us]."""
    parts: tuple[Part, ...]
    copy_gigabytes_per_s: float | None
    """Ceiling: a copy within the device's memory, bytes read and written [GB/s]."""
    host_gigabytes_per_s: float | None
    """Ceiling: a copy to pinned memory of the host [GB/s]; None on a CPU."""

    @property
    def slowest(self) -> Part | None:
        """The part of the step that takes longest alone; the bare cast is a part of the render."""
        timed = [part for part in self.parts if part.per_step_us is not None and part.name != BARE_CAST]
        return max(timed, key=lambda part: part.per_step_us or 0.0, default=None)


BARE_CAST = "bare cast (depth)"
RENDER_ALONE = "render"
SCAN_ALONE = "scan"
PHYSICS_ALONE = "physics"
READ_ALONE = "sort, decode, copy"

SCAN = "event scan alone"
LOOP = "one render and one scan per call, a count read by the host (ours of the frame two before)"
LOOP_AT_ONCE = "one render and one scan per call, the count of that frame read by the host"


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Frames a second of our event camera and of the naive one on the same frames."""

    name: str
    ours_per_s: float | None = None
    naive_per_s: float | None = None
    ours_events: float | None = None
    """Per frame."""
    naive_events: float | None = None
    failure: str = ""

    @property
    def ratio(self) -> float | None:
        """Ours over the naive one."""
        if self.ours_per_s is None or not self.naive_per_s:
            return None
        return self.ours_per_s / self.naive_per_s


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Whether the same flight gives the same, on this device again and on another."""

    what: str
    same: bool | None = None
    """Every byte; None: not to be expected."""
    event_counts: tuple[int, int] | None = None
    rms: float | None = None
    """Of the difference of log radiance."""
    largest: float | None = None
    beyond_share: float | None = None
    """Pixels that differ by more than 0.001."""
    failure: str = ""


@dataclass(frozen=True, kw_only=True)
class ThroughputResult:
    """All of it."""

    device: str
    is_cuda: bool
    quick: bool
    core_count: int
    scene: str
    """That was flown in, except for the study of triangles."""
    scene_triangles: int
    is_house: bool
    """The scene was given: the bars are for a house of 145,844 triangles."""
    rate_hz: float
    max_displacement_px: float
    rows: tuple[StepRow, ...]
    split: Split | None
    split_failure: str
    roofline: Roofline
    scan: Comparison
    loop: Comparison
    loop_at_once: Comparison
    events_per_s: float | None
    """Sorted, on the host, sustained [1/s]."""
    events_failure: str
    agreements: tuple[Agreement, ...]

    def row(self, mode: str, width: int, height: int) -> StepRow | None:
        """Return the row of the study of resolutions that has figures, if there is one."""
        for row in self.rows:
            if (row.study, row.mode, row.width, row.height) == ("resolution", mode, width, height):
                return row if row.steps_per_s is not None else None
        return None

    def fastest(self, mode: str, width: int, height: int) -> StepRow | None:
        """Return the fastest row of a mode and size in the scene that was given, whatever the launch."""
        rows = [
            row
            for row in self.rows
            if row.study in ("resolution", "launch")
            and (row.mode, row.width, row.height) == (mode, width, height)
            and row.steps_per_s is not None
        ]
        return max(rows, key=lambda row: row.steps_per_s or 0.0, default=None)
