"""The batch bearing-only solution with known identities by GTSAM: what a smoother could reach.

    python experiments/batch.py                 every log's own solution
    python experiments/batch.py --sensitivity   and what every noise parameter does to it
    python experiments/batch.py --gains         writes experiments/params/mrclam_d6_r*.toml

All measurements at once, started at the true path; same model as the filter's: `motion.model` with
its gains and the full covariance of every interval, `sensors`' bearing noise (range dependent, at
the current estimate; inflated by `sensors.correlated`), mounting, exact start. The robust kernel is
the filter's too: Gaussian plus uniform clutter with probability `outlier`, by expectation
maximisation: each measurement weighs its posterior probability of not being clutter. Needs GTSAM
(`pip install gtsam`). MRCLAM may not be redistributed: ../shared/data/mrclam, or left out.
"""

import argparse
import json
import time
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from calibration.odometry import fit_odometry
from jaxslam import config_for, default_params, load_log, load_params
from jaxslam.filter.frames import frames_from_log
from jaxslam.logs.readers.mrclam import read_mrclam
from jaxslam.logs.truth import truth_at, wrap
from jaxslam.models import sensors
from jaxslam.models.motion import model
from jaxslam.results.metrics import align_se2, ate, has_truth, map_error, relative_pose

HERE = Path(__file__).parent
NOISES = ("sigma_bearing", "landmark_extent", "err_tran", "err_rot", "err_drift", "floor_tran")
NOISES += ("floor_rot", "outlier", "correlation", "mount_yaw", "gain_rot", "gain_tran")
RESULTS, PARAMS = HERE / "results", HERE / "params"
MRCLAM = HERE.parents[1] / "shared" / "data" / "mrclam" / "MRCLAM_Dataset6"
MISSING = "GTSAM is not installed (pip install gtsam): no batch solution"
SETTLED = 1e-3  # m: rounds end when no pose moves farther
TINY = 1e-6  # m, rad: noise of what the model takes for exact; GTSAM needs some


class Batch(NamedTuple):
    """Path `pose` [T, 3] of the robot and `landmarks` [L, 2] in the world, their `identity` [L],
    `weight` [n]: that a measurement is no clutter; `residual` [n] of the bearings, rad; `cost`: of
    path and map, - log of the posterior density but for a constant."""

    pose: np.ndarray
    landmarks: np.ndarray
    identity: np.ndarray
    weight: np.ndarray
    residual: np.ndarray
    cost: float
    rounds: int
    settled: bool
    seconds: float


def installed():
    """Whether GTSAM can be imported."""
    try:
        import gtsam  # noqa: F401
    except ImportError:
        return False
    return True


def solve(log, params, start=None, rounds=30):
    """`Batch` of a log with bearings and identities; `start` [T, 3]: None for the true path.

    Where truth is missing, odometry carries the start on. Landmarks start where the bearings seen
    from the starting path meet.
    """
    begin = time.perf_counter()
    data = frames_from_log(log, config_for(log, "bearing", "known"), params)
    frame, slot = np.nonzero(data.measurements.valid)
    who, bearing = data.measurements.identity[frame, slot], data.measurements.value[frame, slot, 0]
    pose = true_start(log, data) if start is None else np.array(start, float)
    sensor = compose(pose, mounting(params))
    points = triangulate(sensor[frame], bearing, who, len(data.identities))
    move, cov = motion(data.odometry, params)
    first = compose(np.array(log.start_pose)[None], mounting(params))[0]
    fixed = prior(log, params), first
    noise = bearing_noise(data.odometry, params)
    for done in range(1, rounds + 1):  # noqa: B007
        residual, variance = bearing_residuals(sensor, points, (frame, who, bearing), noise)
        weight = inlier(residual, variance, noise, frame, params)[0]
        before = sensor
        sensor, points = optimise(
            fixed, (move, cov), (frame, who, bearing, variance / weight), (sensor, points)
        )
        settled = np.abs((sensor - before)[:, :2]).max() < SETTLED
        if settled:
            break
    residual, variance = bearing_residuals(sensor, points, (frame, who, bearing), noise)
    weight, density = inlier(residual, variance, noise, frame, params)
    cost = motion_cost(np.vstack([fixed[1], sensor]), move, cov) - np.log(density).sum()
    seconds = time.perf_counter() - begin
    pose = compose(sensor, compose_inverse(mounting(params)))
    return Batch(pose, points, data.identities, weight, residual, float(cost), done,
                 bool(settled), seconds)  # fmt: skip


def optimise(fixed, chain, bearings, values):
    """One Gaussian least-squares problem by GTSAM: sensor poses [T, 3] and landmarks [L, 2].

    `fixed`: covariance and pose before the first interval; `chain`: motion [T, 3] and covariance
    [T, 3, 3]; `bearings`: frame, landmark, value and variance, each [n].
    """
    import gtsam
    from gtsam.noiseModel import Gaussian, Isotropic

    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    (cov, first), (poses, points) = fixed, values
    lift = len(poses) + 1
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*first), Gaussian.Covariance(cov)))
    initial.insert(0, gtsam.Pose2(*first))
    for i, (move, noise, pose) in enumerate(zip(*chain, poses, strict=True)):
        initial.insert(i + 1, gtsam.Pose2(*pose))
        noise = Gaussian.Covariance(noise)
        graph.add(gtsam.BetweenFactorPose2(i, i + 1, gtsam.Pose2(*move), noise))
    for i, point in enumerate(points):
        initial.insert(lift + i, gtsam.Point2(*point))
    for t, who, value, variance in zip(*(part.tolist() for part in bearings), strict=True):
        noise = Isotropic.Sigma(1, variance**0.5)
        graph.add(gtsam.BearingFactor2D(t + 1, lift + who, gtsam.Rot2(value), noise))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-9)
    found = gtsam.LevenbergMarquardtOptimizer(graph, initial, settings).optimize()
    poses = [found.atPose2(i + 1) for i in range(len(poses))]
    points = [found.atPoint2(lift + i) for i in range(len(points))]
    return np.array([(p.x(), p.y(), p.theta()) for p in poses]), np.array(points)


def motion(odometry, params):
    """Sensor's motion [T, 3] over the intervals, and its covariance [T, 3, 3] in the frame at the
    intervals' (predicted) end, where GTSAM has its residuals."""
    with jax.enable_x64(True):
        m = model(odometry, params)
        m = type(m)(*(np.asarray(leaf, float) + np.zeros(len(odometry.dx)) for leaf in m))
    c, s, zero = np.cos(m.chord - m.turn), np.sin(m.chord - m.turn), np.zeros(len(m.turn))
    one = np.ones(len(m.turn))
    # columns: noise along the chord, of the heading (with its sideways part), sideways
    root = np.array([[c, -s * m.slope, -s], [s, c * m.slope, c], [zero, one, zero]])
    root = root.transpose(2, 0, 1)
    root = root * np.sqrt(np.column_stack([m.var_along, m.var_heading, m.var_rest]))[:, None]
    robot = np.column_stack([m.length * np.cos(m.chord), m.length * np.sin(m.chord), m.turn])
    mount = mounting(params)
    moved = compose(compose(compose_inverse(mount), robot), mount)
    root = to_sensor(mount) @ root
    return moved, root @ root.transpose(0, 2, 1) + TINY**2 * np.eye(3)


def prior(log, params):
    """Covariance [3, 3] of the sensor's pose at the start, in its own frame."""
    c, s = np.cos(log.start_pose[2]), np.sin(log.start_pose[2])
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    root = to_sensor(mounting(params)) @ turn
    return root @ log.start_cov @ root.T + TINY**2 * np.eye(3)


def mounting(params):
    return np.array([[params.mount_x, params.mount_y, params.mount_yaw]], float)


def to_sensor(mount):
    """Adjoint [3, 3] that turns a small motion of the robot's frame into one of the sensor's."""
    x, y, yaw = mount[0]
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, s, s * x - c * y], [-s, c, c * x + s * y], [0, 0, 1]])


def compose(pose, offset):
    """Poses [T, 3] after the offsets [T, 3] in their frames."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    x = pose[:, 0] + c * offset[:, 0] - s * offset[:, 1]
    y = pose[:, 1] + s * offset[:, 0] + c * offset[:, 1]
    return np.column_stack([x, y, wrap(pose[:, 2] + offset[:, 2])])


def compose_inverse(pose):
    """The poses [T, 3] that undo these."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    x, y = c * pose[:, 0] + s * pose[:, 1], c * pose[:, 1] - s * pose[:, 0]
    return np.column_stack([-x, -y, -pose[:, 2]])


def bearing_noise(odometry, params):
    """Variance far away and variance x range^2 of the frames' bearings [T], inflated, and both not
    inflated (the measurement is judged by its own noise)."""
    with jax.enable_x64(True):
        inflated = sensors.correlated_noise(params, odometry)
    ones = np.ones(len(odometry.dx))
    return (
        np.asarray(inflated.sigma_bearing, float) ** 2 * ones,
        np.asarray(inflated.landmark_extent, float) ** 2 * ones,
    )


def bearing_residuals(sensor, points, seen, noise):
    """Residuals [n] of the bearings and their variances, which depend on range."""
    frame, who, bearing = seen
    offset = points[who] - sensor[frame, :2]
    residual = wrap(np.arctan2(offset[:, 1], offset[:, 0]) - sensor[frame, 2] - bearing)
    return residual, noise[0][frame] + noise[1][frame] / np.maximum((offset**2).sum(1), 1e-6)


def inlier(residual, variance, noise, frame, params):
    """Posterior probability [n] that a bearing is no clutter, which is uniform over the view, and
    density [n] under both; what `correlated` does to the variance is left out of the decision."""
    share = (noise[0] / params.sigma_bearing**2)[frame]
    alone = variance / share
    normal = np.exp(-0.5 * residual**2 / alone) / np.sqrt(2 * np.pi * alone)
    normal = (1 - params.outlier) * normal
    clutter = params.outlier / (params.view_max - params.view_min) + 1e-300
    # a measurement that counts for `1 / share` of one adds as much of its log density
    return np.maximum(normal / (normal + clutter), 1e-9), (normal + clutter) ** (1 / share)


def motion_cost(sensor, move, cov):
    """- log density of the path [1 + T, 3] under the intervals' motion, but for a constant."""
    step = relative_pose(sensor[:-1], sensor[1:]) - move
    c, s = np.cos(move[:, 2]), np.sin(move[:, 2])
    error = np.column_stack(
        [c * step[:, 0] + s * step[:, 1], c * step[:, 1] - s * step[:, 0], wrap(step[:, 2])]
    )
    squares = error * np.linalg.solve(cov, error[:, :, None])[:, :, 0]
    return (squares.sum() + np.linalg.slogdet(cov)[1].sum()) / 2


def true_start(log, data):
    """True poses [T, 3] at the frames, carried on by odometry where there are none."""
    pose = truth_at(log.truth, data.time)
    move = np.column_stack([data.odometry.dx, data.odometry.dy, data.odometry.dtheta])
    last = np.array(log.start_pose)[None]
    for i in range(len(pose)):
        if not np.isfinite(pose[i]).all():
            pose[i] = compose(last, move[i : i + 1])[0]
        last = pose[i : i + 1]
    return pose


def triangulate(sensor, bearing, who, count):
    """Points [L, 2] nearest, in angle, to the rays from sensor poses [n, 3] (least squares)."""
    angle = sensor[:, 2] + bearing
    normal = np.column_stack([-np.sin(angle), np.cos(angle)])
    offset = (normal * sensor[:, :2]).sum(1)
    points = np.zeros((count, 2))
    for i in range(count):
        rows = who == i
        weight = np.ones(rows.sum())
        for _ in range(5):
            a, b = normal[rows] * weight[:, None], offset[rows] * weight
            points[i] = np.linalg.lstsq(a, b, rcond=1e-6)[0]
            weight = 1 / np.maximum(np.hypot(*(points[i] - sensor[rows, :2]).T), 0.3)
    return points


def errors(batch, log):
    """Errors of a batch solution: `ate_m` aligned and not, and its landmarks, aligned as the path
    is (`landmark_m`) and not; `scale` of the map over the true one."""
    true = truth_at(log.truth, log.frame_time)
    have = has_truth(true)
    found = {
        "ate_m": ate(batch.pose, true)[0],
        "ate_unaligned_m": ate(batch.pose, true, align=False)[0],
    }
    if log.truth.landmarks is None:
        return found
    to_truth = align_se2(batch.pose[have, :2], true[have, :2])
    for name, move in (("landmark_m", to_truth), ("landmark_unaligned_m", None)):
        found[name] = map_error(batch.landmarks, batch.identity, log.truth, move)["rmse_m"]
    places = dict(zip(log.truth.landmark_id.tolist(), log.truth.landmarks, strict=True))
    rows = [i for i, who in enumerate(batch.identity.tolist()) if who in places]
    there = np.array([places[int(who)] for who in batch.identity[rows]])
    here = batch.landmarks[rows]
    return found | {"scale": float(np.sqrt(here.var(0).sum() / there.var(0).sum()))}


def mrclam(robot):
    """`Log` of a robot of MRCLAM's dataset 6 and the file of its gains; None where it is absent."""
    if not MRCLAM.is_dir():
        return None, None
    return read_mrclam(MRCLAM, robot), PARAMS / f"mrclam_d6_r{robot}.toml"


def gained(log, file=None, sensor="bearing"):
    """Default parameters of a sensor, with a robot's own gains where there is a file of them."""
    params = default_params(sensor, log)
    return load_params(file, params) if file is not None and file.exists() else params


def write_gains():
    """A parameter file with the gains of each robot of MRCLAM's dataset 6: odometry against truth.

    They are the whole run's, so what is scored with them has seen that much of its truth. Without
    truth the most probable ones were up to 0.14 off in `gain_rot`.
    """
    PARAMS.mkdir(exist_ok=True)
    for robot in range(1, 6):
        log, file = mrclam(robot)
        found, _, _, _ = fit_odometry(log, interval=1.0)
        gain, bias = found["gain_rot"], found["bias_drift"]
        file.write_text(
            f"# MRCLAM dataset 6, robot {robot}: odometry against truth, batch.py --gains\n"
            f"gain_rot = {gain:.3f}  # true / measured\n"
            f"bias_drift = {bias:.3f}  # rad/m\n"
        )
        print(file.name, f"{gain:.3f} {bias:.3f}", flush=True)


def variants(params):
    """Name and `Params`: as they are, and each noise at a third and three times its value."""
    yield "as they are", params
    for name in NOISES:
        value = getattr(params, name)
        for factor in (1 / 3, 3):
            if name == "mount_yaw":
                changed, title = value + np.radians(factor), f"+ {factor:.2g} deg"
            elif name.startswith("gain"):
                changed, title = value * (0.95 if factor < 1 else 1.05), "* 0.95 or 1.05"
            else:
                changed, title = value * factor, f"* {factor:.2g}"
            if changed != value:
                yield f"{name} {title}", params._replace(**{name: changed})


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--sensitivity", action="store_true")
    options.add_argument("--gains", action="store_true")
    options = options.parse_args()
    if not installed():
        raise SystemExit(MISSING)
    if options.gains:
        return write_gains()
    lines = ["| log | parameters | path [m] | landmarks [m] | scale | rounds | seconds |"]
    lines += ["|---|---|--:|--:|--:|--:|--:|"]
    print(*lines, sep="\n")
    content = []
    logs = [(load_log("lost-in-the-woods"), None), *(mrclam(robot) for robot in range(1, 6))]
    for log, file in logs:
        if log is None:
            continue
        for name, params in variants(gained(log, file)):
            found = solve(log, params)
            error = errors(found, log)
            content.append({"log": log.name, "parameters": name, **error})
            lines.append(
                f"| {log.name} | {name} | {error['ate_m']:.3f} | {error['landmark_m']:.3f} "
                f"| {error['scale']:.3f} | {found.rounds} | {found.seconds:.0f} |"
            )
            print(lines[-1], flush=True)
            if not options.sensitivity:
                break
    RESULTS.mkdir(exist_ok=True)
    name = "batch_sensitivity" if options.sensitivity else "batch"
    (RESULTS / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n")
    (RESULTS / f"{name}.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
