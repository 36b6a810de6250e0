"""A small result made by hand, for the tests of what comes after the filter."""

import dataclasses

import numpy as np

from jaxslam.config import Config
from jaxslam.logs.log import FloorPlan, Log, Truth
from jaxslam.parameters import Params
from jaxslam.results.result import MapEstimate, Result
from jaxslam.smoother.genealogy import Ancestral, Lineage
from jaxslam.smoother.refine import Refined

LANDMARKS = np.array([[3.0, 0.0], [0.0, 3.0], [-3.0, 0.0], [0.0, -3.0]])
START = 1_700_000_000_123_456_789  # ns


def make_log(frames=40, truth=True):
    """Round a circle of 2 m radius in 0.2 s steps; frame k measures landmarks k % 4 and clutter."""
    time = START + 200_000_000 * np.arange(frames)
    angle = 0.1 * np.arange(frames)
    pose = np.stack([2 * np.cos(angle), 2 * np.sin(angle), angle + np.pi / 2], 1)
    seen = np.stack([np.arange(frames) % 4, np.full(frames, -1)], 1).ravel()
    known = Truth(time, pose, LANDMARKS, np.arange(4) + 10, np.where(seen < 0, -1, seen + 10))
    corners = np.array([[-4, -4], [4, -4], [4, 4], [-4, 4]], float)
    return Log(
        name="circle",
        odometry_time=time,
        odometry=np.tile([1.0, 0.5], (frames, 1)),
        frame_time=time,
        frame=np.repeat(np.arange(frames), 2),
        bearing=np.zeros(2 * frames),
        range=np.ones(2 * frames),
        view=(-np.pi, np.pi, 6.0),
        start_pose=pose[0],
        truth=known if truth else None,
        plan=FloorPlan(segments=np.hstack([corners, np.roll(corners, -1, 0)])),
    )


def make_result(frames=40, truth=True, shift=0.1):
    """Everything estimated `shift` metres too far in x; rightly associated; two measurements."""
    log = make_log(frames, truth)
    pose = np.array(make_log(frames).truth.pose)
    pose[:, 0] += shift
    reckoning = pose + np.linspace(0, 1, frames)[:, None] * [0.5, 0.5, 0.1]
    row = np.full((frames, 3), -1)
    row[:, :2] = np.arange(2 * frames).reshape(-1, 2)
    landmark_id = np.full((frames, 3), -3)
    landmark_id[:, 1] = -2
    landmark_id[:, 0] = np.where(np.arange(frames) < 4, -1, np.arange(frames) % 4 * 3)
    marks = np.vstack([LANDMARKS + np.array([shift, 0]), [[30.0, 30.0]]])
    zero = np.zeros(frames)
    return Result(
        log=log,
        config=Config(particles=100),
        params=Params(*np.linspace(0.1, 1 / 3, len(Params._fields)).astype(np.float32)),
        seed=7,
        time=log.frame_time,
        pose=pose,
        cov=np.tile(np.diag([0.01, 0.02, 0.001]), (frames, 1, 1)),
        ess=100 - 3.0 * (np.arange(frames) % 20),
        resampled=np.arange(frames) % 20 == 19,
        new=(np.arange(frames) < 4).astype(int),
        overflow=zero,
        outliers=zero + 1,
        forgotten=zero,
        log_evidence=zero - 1.5,
        nonfinite=zero.astype(int),
        degenerate=zero > 0,
        landmark_id=landmark_id,
        row=row,
        landmarks=MapEstimate(
            id=np.array([0, 3, 6, 9, 50]),
            mean=marks,
            cov=np.tile([0.02, 0.01, 0.03], (5, 1)),
            n=np.array([10, 10, 10, 10, 2]),
            identity=np.full(5, -1),
        ),
        dead_reckoning=reckoning,
        seconds=1.25,
        compile_seconds=0.5,
        dropped={"no measurement slot": 3},
    )


def make_refined(frames=40, truth=True, shift=0.1):
    """The same, looking back: the ancestral path is off by 0.8 shifts, the refined one by half."""
    result = make_result(frames, truth, shift)
    back = np.array([shift, 0, 0])
    world = result.landmarks
    few = slice(0, 4)
    return dataclasses.replace(
        result,
        ancestral=Ancestral(result.pose - 0.2 * back, result.cov / 2, np.arange(frames) // 10 + 1),
        lineage=Lineage(result.pose - 0.3 * back, result.landmark_id),
        refined=Refined(
            pose=result.pose - 0.5 * back,
            cov=result.cov / 4,
            id=world.id[few],
            mean=world.mean[few] - 0.5 * back[:2],
            landmark_cov=world.cov[few] / 4,
            n=world.n[few],
            identity=world.identity[few],
            landmark_id=np.where(np.arange(frames)[:, None] == 8, -2, result.landmark_id),
            rounds=3,
            iterations=20,
            cost=-12.5,
            converged=True,
            merged=1,
            dropped=0,
            residual=0.9,
        ),
        refine_seconds=0.75,
    )
