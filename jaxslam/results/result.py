"""What a run found: the `Result`, and what is to be said about it."""

from dataclasses import dataclass
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


FEWEST, UNLIKELY, WARPED = 3, 9.2, 0.1  # landmarks; chi-square of 2 (99 %); m


class MapEstimate(NamedTuple):
    """L landmarks: `id` [L], world `mean` [L, 2] m and `cov` [L, 3] (xx, xy, yy) m^2, times seen
    `n` [L], and the log's `identity` [L] (-1 where identities were hidden)."""

    id: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    n: np.ndarray
    identity: np.ndarray


@dataclass(frozen=True)
class Result:
    """A run's estimates, frame by frame, T frames.

    `time` int64 [T] ns. `pose` [T, 3] (x, y, heading): filtered mean, m and rad, in the frame of
    the log's start pose; `cov` [T, 3, 3]. `ess` [T]; `resampled` [T]; `new` [T]: landmarks begun by
    the best particle; `overflow`, `forgotten`, `outliers` [T]: mean number per particle;
    `log_evidence` [T]; `nonfinite`, `degenerate` [T]: flags of `filter.Info`. `landmark_id` [T, K]: what
    the best particle took each measurement for (frame * K + k of the measurement that began the
    landmark, or -1 new, -2 clutter, -3 padding), `row` [T, K]: the measurement's row in the log.
    `landmarks`: the map at the end. `dead_reckoning` [T, 3]: odometry alone. `dropped`: rows left
    out, by reason.

    What looks back: `ancestral`: the posterior over the whole path, `lineage`: the past of the
    particle that was best at the end (both None if the genealogy took too much memory), and
    `refined`: that past and its map by least squares, in `refine_seconds` (None: not refined).
    `entropy` [T, K], nats: how much particles differed about what each measurement is of
    (`ambiguity`). `events` [E, 4]: what rejuvenation did to the map (`rejuvenation.Past`; None:
    there was none).
    """

    log: Log
    config: Config
    params: Params
    seed: int
    time: np.ndarray
    pose: np.ndarray
    cov: np.ndarray
    ess: np.ndarray
    resampled: np.ndarray
    new: np.ndarray
    overflow: np.ndarray
    outliers: np.ndarray
    forgotten: np.ndarray
    log_evidence: np.ndarray
    nonfinite: np.ndarray
    degenerate: np.ndarray
    landmark_id: np.ndarray
    row: np.ndarray
    landmarks: MapEstimate
    dead_reckoning: np.ndarray
    seconds: float
    compile_seconds: float
    dropped: dict[str, int]
    ancestral: Ancestral | None = None
    lineage: Lineage | None = None
    refined: "Refined | None" = None
    refine_seconds: float | None = None
    events: np.ndarray | None = None
    entropy: np.ndarray | None = None

    @property
    def match(self) -> np.ndarray:
        """`landmark_id` by its name of version 0.1."""
        return self.landmark_id

    @property
    def landmarks_refined(self) -> MapEstimate | None:
        """The refined map, or None."""
        found = self.refined
        if found is None:
            return None
        return MapEstimate(found.id, found.mean, found.landmark_cov, found.n, found.identity)

    @property
    def log_likelihood(self) -> float:
        """Log evidence of the whole log, nats."""
        return float(np.sum(self.log_evidence, dtype=float))

    @cached_property
    def flags(self) -> list[str]:
        """One line for everything that was lost or went wrong; empty when nothing did."""
        lines = [f"{count} measurements left out: {why}" for why, count in self.dropped.items()]
        lines += [
            f"{count} rows skipped by the reader: {why}"
            for why, count in self.log.skipped.items()
            if not why.startswith(NOT_USED)
        ]
        lost = float(np.sum(self.overflow))
        if lost > 0:
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
            lines.append("path and map could not be refined, for want of memory or of a solution")
        return lines

    @cached_property
    def advice(self) -> list[str]:
        """One line for everything that is no fault but should be known."""
        return self._shared_past + self._failed + self._warped

    @property
    def _failed(self):
        """A line if a past could not be refined on the way."""
        failed = 0 if self.events is None else int(np.sum(self.events[:, 1] == FAILED))
        if not failed:
            return []
        return [f"the past could not be refined {failed} times; the filter went on without"]

    @property
    def _warped(self):
        """A line if the filter's map and the refined one, of the same landmarks, disagree."""
        if self.refined is None:
            return []
        mine, other = self.landmarks, self.landmarks_refined
        _, i, j = np.intersect1d(mine.id, other.id, return_indices=True)
        if len(i) < FEWEST:
            return []
        off = mine.mean[i] - other.mean[j]
        xx, xy, yy = (mine.cov[i] + other.cov[j]).T
        square = yy * off[:, 0] ** 2 - 2 * xy * off[:, 0] * off[:, 1] + xx * off[:, 1] ** 2
        square, distance = np.median(square / (xx * yy - xy**2)), np.median(np.hypot(*off.T))
        if square < UNLIKELY or distance < WARPED:
            return []
        return [
            f"the filter's map and the refined one differ by {distance:.2f} m in the median, "
            f"{np.sqrt(square):.1f} standard deviations: one of them is likely warped"
        ]

    @property
    def _shared_past(self):
        if self.ancestral is None:
            return [
                "the particles' genealogy took too much memory: only the filter's path is there"
                + (", rejuvenated no more from then on" if self.config.rejuvenate else "")
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
        """Write the run's folder (`report.save`); without a `log_source` the log is copied too."""
        from jaxslam.results import run_folder  # here: it brings matplotlib

        run_folder.save(self, directory, overwrite=overwrite, log_source=log_source)
