"""The `Result` of a run, with warnings and advice about it."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxslam.config import Config
from jaxslam.logs.log import NOT_USED, Log
from jaxslam.parameters import Params
from jaxslam.smoother.events import FAILED
from jaxslam.smoother.genealogy import Ancestral, Lineage

if TYPE_CHECKING:
    from jaxslam.smoother.refine import Refined

# Two maps disagree if they share so many landmarks, with so large a median chi-square of 2 (99 %)
# and distance [m].
MIN_LANDMARKS, MIN_CHI_SQUARE, MIN_DISTANCE = 3, 9.2, 0.1


class MapEstimate(NamedTuple):
    """L landmarks in the world frame: `id` [L] (landmark id), `mean` [L, 2] m, `cov` [L, 3]
    (xx, xy, yy) m^2, number of measurements `n` [L], and the log's `identity` [L] (-1: unknown)."""

    id: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    n: np.ndarray
    identity: np.ndarray

    def __repr__(self):
        return f"MapEstimate({len(self.mean)} landmarks)"


COLUMN = {"column": True}  # of a field of `Result` that is a column of `steps.npz`


@dataclass(frozen=True, repr=False)
class Result:
    """Estimates of a run over T frames.

    Filtered, by frame: `time` int64 [T] ns; `pose` [T, 3] (x, y, heading) and `cov` [T, 3, 3], mean
    and covariance in m and rad, in the frame of the log's start pose; `ess` [T]; `resampled` [T];
    `new` [T]: landmarks that the best particle began; `overflow`, `forgotten`, `outliers` [T]: mean
    number per particle; `log_evidence` [T]; `nonfinite`, `degenerate` [T]: flags of `step.Info`;
    `landmark_id` [T, K]: landmark that the best particle matched each measurement with
    (frame * K + k of the measurement that began it; -1 new, -2 clutter, -3 padding); `row` [T, K]:
    the measurement's row in the log; `dead_reckoning` [T, 3]: odometry alone. `landmarks`: the
    map at the end. `dropped`: number of rows left out, by reason. `entropy` [T, K], nats:
    disagreement of the particles about a match (`events.association_entropy`).

    Smoothed: `ancestral`: mean and covariance of the surviving particles' paths; `lineage`: path of
    the particle that was best at the end (both None where the genealogy took too much memory);
    `refined`: that path and its map by least squares, in `refine_seconds` (None: not refined).
    `events` [E, 4]: what rejuvenation changed in the map (`rejuvenation.SharedPast`), or None.
    """

    log: Log
    config: Config
    params: Params
    seed: int
    time: np.ndarray = field(metadata=COLUMN)
    pose: np.ndarray = field(metadata=COLUMN)
    cov: np.ndarray = field(metadata=COLUMN)
    ess: np.ndarray = field(metadata=COLUMN)
    resampled: np.ndarray = field(metadata=COLUMN)
    new: np.ndarray = field(metadata=COLUMN)
    overflow: np.ndarray = field(metadata=COLUMN)
    outliers: np.ndarray = field(metadata=COLUMN)
    forgotten: np.ndarray = field(metadata=COLUMN)
    log_evidence: np.ndarray = field(metadata=COLUMN)
    nonfinite: np.ndarray = field(metadata=COLUMN)
    degenerate: np.ndarray = field(metadata=COLUMN)
    landmark_id: np.ndarray = field(metadata=COLUMN)
    row: np.ndarray = field(metadata=COLUMN)
    landmarks: MapEstimate
    dead_reckoning: np.ndarray = field(metadata=COLUMN)
    seconds: float
    compile_seconds: float
    dropped: dict[str, int]
    ancestral: Ancestral | None = None
    lineage: Lineage | None = None
    refined: "Refined | None" = None
    refine_seconds: float | None = None
    events: np.ndarray | None = field(default=None, metadata=COLUMN)
    entropy: np.ndarray | None = field(default=None, metadata=COLUMN)

    def __repr__(self):
        counts = f"{len(self.time)} frames, {len(self.landmarks.mean)} landmarks"
        return f"Result({self.log.name!r}, {self.config.sensor}, {counts})"

    def trajectory_columns(self) -> dict[str, np.ndarray]:
        """Return the trajectory as columns [T], for `pandas.DataFrame` for example.

        Metres, radians, and seconds since the epoch or the start of the clock (`time_ns` is exact).
        `smoothed_...` only if the run was refined.
        """
        parts = {"": (self.pose, self.cov)}
        if self.refined is not None:
            parts["smoothed_"] = (self.refined.pose, self.refined.cov)
        columns = {"time_ns": self.time, "time_s": self.time / 1e9}
        for prefix, (pose, cov) in parts.items():
            for i, name in enumerate(("x_m", "y_m", "heading_rad")):
                columns[prefix + name] = pose[:, i]
                columns[f"{prefix}sd_{name}"] = np.sqrt(cov[:, i, i])
        return columns | {"ess": self.ess, "log_evidence": self.log_evidence}

    def landmark_columns(self, smoothed: bool = True) -> dict[str, np.ndarray]:
        """Return the map as columns [L], in m and m^2: the refined one if there is one and
        `smoothed`, else the filter's."""
        marks = self.landmarks_refined if smoothed and self.refined is not None else self.landmarks
        assert marks is not None
        values = np.column_stack([np.reshape(marks.mean, (-1, 2)), np.reshape(marks.cov, (-1, 3))])
        columns = dict(zip(("x_m", "y_m", "sxx", "sxy", "syy"), values.T, strict=True))
        return {"id": marks.id, **columns, "n": marks.n, "identity": marks.identity}

    @property
    def match(self) -> np.ndarray:
        """`landmark_id` by its name of version 0.1."""
        return self.landmark_id

    @property
    def landmarks_refined(self) -> MapEstimate | None:
        """The refined map, or None."""
        if (r := self.refined) is None:
            return None
        return MapEstimate(r.id, r.mean, r.landmark_cov, r.n, r.identity)

    @property
    def log_likelihood(self) -> float:
        """Log evidence of the whole log, nats."""
        return float(np.sum(self.log_evidence, dtype=float))

    @cached_property
    def flags(self) -> list[str]:
        """Warnings: a line for everything that was lost or went wrong."""
        lines = [f"{count} measurements left out: {why}" for why, count in self.dropped.items()]
        for why, count in self.log.skipped.items():
            if not why.startswith(NOT_USED):
                lines.append(f"{count} rows skipped by the reader: {why}")
        if (lost := float(np.sum(self.overflow))) > 0:
            frame = int(np.flatnonzero(self.overflow)[0])
            lines.append(
                f"the map was full from frame {frame} on: {lost:.1f} landmarks lost per particle; "
                f"more than {self.config.landmarks} landmark slots are needed"
            )
        if np.any(self.nonfinite):
            lines.append(f"{int(np.sum(self.nonfinite))} particle weights were not finite")
        if np.any(self.degenerate):
            lines.append(f"all weights were zero in {int(np.sum(self.degenerate))} frames")
        if not (np.isfinite(self.pose).all() and np.isfinite(self.cov).all()):
            lines.append("the pose estimate is not finite")
        if self.refined is None and self.refine_seconds is not None:
            lines.append("path and map could not be refined: too little memory, or no solution")
        return lines

    @cached_property
    def advice(self) -> list[str]:
        """Notes: a line for everything that is no fault but limits what the result says."""
        return self._describe_shared_past() + self._describe_failures() + self._describe_warp()

    def _describe_failures(self):
        """Return a line if rejuvenation failed."""
        failed = 0 if self.events is None else int(np.sum(self.events[:, 1] == FAILED))
        line = f"rejuvenation failed {failed} times, since the path could not be refined"
        return [line] if failed else []

    def _describe_warp(self):
        """Return a line if the filter's map and the refined one, of common landmarks, disagree."""
        if self.refined is None:
            return []
        filtered, refined = self.landmarks, self.landmarks_refined
        _, i, j = np.intersect1d(filtered.id, refined.id, return_indices=True)
        if len(i) < MIN_LANDMARKS:
            return []
        off = filtered.mean[i] - refined.mean[j]
        xx, xy, yy = (filtered.cov[i] + refined.cov[j]).T
        square = yy * off[:, 0] ** 2 - 2 * xy * off[:, 0] * off[:, 1] + xx * off[:, 1] ** 2
        square, distance = np.median(square / (xx * yy - xy**2)), np.median(np.hypot(*off.T))
        if square < MIN_CHI_SQUARE or distance < MIN_DISTANCE:
            return []
        return [
            f"the filter's map and the refined one differ by {distance:.2f} m in the median, "
            f"{np.sqrt(square):.1f} standard deviations: one of them is likely warped"
        ]

    def _describe_shared_past(self):
        """Return a line if all particles descend from one ancestor, or if that is not known."""
        if self.ancestral is None:
            return [
                "the particles' genealogy took too much memory: there is no smoothed path"
                + (", and no rejuvenation from then on" if self.config.rejuvenate else "")
            ]
        if not len(self.time) or self.ancestral.distinct[0] > 1:
            return []
        last = np.flatnonzero(self.ancestral.distinct == 1)[-1]
        seconds = (self.time[-1] - self.time[last]) / 1e9
        share = (last + 1) / len(self.time)
        return [
            f"all particles share one past up to {seconds:.1f} s before the end ({share:.1%} of "
            "the path): the ancestral covariance says nothing about it"
        ]

    def save(
        self, directory: str | Path, overwrite: bool = False, log_source: str | None = None
    ) -> None:
        """Write a run folder (`run_folder.save`), which holds the log unless it has a source."""
        from jaxslam.results import run_folder  # here: it brings matplotlib

        run_folder.save(self, directory, overwrite=overwrite, log_source=log_source)
