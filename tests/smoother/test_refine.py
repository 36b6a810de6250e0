"""Refining one lineage: exact where the answer is known, robust where the start is poor."""

import jax
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from jaxslam.filter.frames import Frames, frames_from_log
from jaxslam.logs.odometry import Odometry, dead_reckoning
from jaxslam.logs.truth import wrap
from jaxslam.models.sensors import Measurements
from jaxslam.parameters import default_params
from jaxslam.results.metrics import ate, pair_by_distance
from jaxslam.runs.run import config_for
from jaxslam.simulation import planar
from jaxslam.smoother import least_squares as bundle
from jaxslam.smoother import normal_equations
from jaxslam.smoother.refine import refine

WORLD = np.array([[2.0, 1.0], [0.0, -1.5], [3.5, -0.5]])


def drive(steps, rng, turn=0.5):
    """Odometry of a drive with uneven steps, and its dead reckoning from the origin."""
    dtheta, ahead = rng.uniform(-turn, turn, steps), rng.uniform(0.2, 0.5, steps)
    full = np.full(steps, 0.5)
    zero = np.zeros(steps)
    odometry = Odometry(ahead, zero, dtheta, ahead, np.abs(dtheta), full, full, full / 6)
    return odometry, dead_reckoning(odometry, np.zeros(3))


def as_frames(odometry, value, cov=None, identity=None):
    """`Frames` in which every landmark is measured in every frame."""
    shape = value.shape[:2]
    identity = np.tile(np.arange(shape[1], dtype=np.int32), (shape[0], 1))
    cov = np.zeros((*shape, 3)) if cov is None else np.broadcast_to(cov, (*shape, 3))
    measurements = Measurements(value, cov, identity, np.ones(shape, bool), np.ones(shape[0], bool))
    time = np.arange(shape[0])
    return Frames(time, odometry, measurements, np.arange(shape[1]), np.zeros(shape), {})


def seen_from(pose, world):
    """Ranges and bearings [T, L] of the landmarks."""
    off = world[None] - pose[:, None, :2]
    bearing = wrap(np.arctan2(off[..., 1], off[..., 0]) - pose[:, 2, None])
    return np.hypot(off[..., 0], off[..., 1]), bearing


def params_of(sensor, **changes):
    given = dict(err_tran=0.2, err_rot=0.1, err_drift=0.1, floor_tran=0.02, floor_rot=0.02)
    given |= dict(landmark_extent=0.0, outlier=0.0, correlation=0.0)
    return default_params(sensor)._replace(**given | changes)


@pytest.mark.parametrize("points", [0, 1, 4])
def test_chain_is_the_dense_solution(points):
    """Steps and covariances of a random problem equal those of dense linear algebra."""
    rng, poses = np.random.default_rng(points), 5
    dense = np.zeros((3 * poses + 2 * points,) * 2)
    for t in range(poses):
        rows = np.arange(3 * t, 3 * min(t + 2, poses))
        touched = np.append(rows, np.arange(3 * poses, len(dense)))
        for _ in range(5):
            row = np.zeros(len(dense))
            some = np.append(rows, rng.choice(touched, 2))
            row[some] = rng.normal(size=len(some))
            dense += np.outer(row, row)
    # points must not touch one another
    corner = dense[3 * poses :, 3 * poses :]
    own = np.kron(np.eye(points), np.ones((2, 2)))
    corner[...] = corner * own + 60 * np.eye(2 * points)
    right = rng.normal(size=len(dense))
    blocks = dense[: 3 * poses, : 3 * poses].reshape(poses, 3, poses, 3)
    at = np.arange(poses)
    normal = normal_equations.NormalEquations(
        diagonal=blocks[at, :, at],
        off=blocks[at[:-1], :, at[1:]],
        border=normal_equations.csr_array(dense[3 * poses :, : 3 * poses]),
        corner=np.array(
            [corner[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] for i in range(points)]
        ).reshape(points, 2, 2),
        pose_gradient=right[: 3 * poses].reshape(poses, 3),
        point_gradient=right[3 * poses :].reshape(points, 2),
    )
    pose, point, factor = normal_equations.solve(normal)
    step, cov = np.linalg.solve(dense, right), np.linalg.inv(dense)
    np.testing.assert_allclose(np.append(pose, point), step, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(factor.points, cov[3 * poses :, 3 * poses :], rtol=1e-9, atol=1e-12)
    ours = cov[: 3 * poses, : 3 * poses].reshape(poses, 3, poses, 3)[at, :, at]
    np.testing.assert_allclose(
        normal_equations.pose_covariances(factor), ours, rtol=1e-8, atol=1e-12
    )


def test_chain_says_when_a_matrix_is_not_positive_definite():
    normal = normal_equations.NormalEquations(
        -np.eye(3)[None],
        np.zeros((0, 3, 3)),
        normal_equations.csr_array((0, 3)),
        np.zeros((0, 2, 2)),
        np.zeros((1, 3)),
        np.zeros((0, 2)),
    )
    with pytest.raises(np.linalg.LinAlgError):
        normal_equations.solve(normal)


def smoothed(odometry, value, start_cov, params, noise):
    """Means and covariances of positions and landmarks with headings known: linear, dense."""
    steps, count = value.shape[:2]
    size = 2 * (steps + 1 + count)
    information, right = np.zeros((size, size)), np.zeros(size)
    heading = np.append(0.0, np.cumsum(odometry.dtheta))

    def turned(angle):
        return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])

    def add(parts, error, cov):
        row = np.zeros((2, size))
        for place, block in parts:
            row[:, 2 * place : 2 * place + 2] = block
        weight = np.linalg.inv(cov)
        information[...] += row.T @ weight @ row
        right[...] += row.T @ weight @ error

    add([(0, np.eye(2))], np.zeros(2), start_cov)
    for t in range(steps):
        floor = params.floor_tran**2 * odometry.duration[t]
        along = params.err_tran**2 * odometry.distance[t] + floor
        ahead = turned(heading[t])
        moved = np.array([odometry.dx[t], 0])
        add([(t, -ahead), (t + 1, ahead)], moved, np.diag([along, floor]))
        look = turned(heading[t + 1])
        for i in range(count):
            add([(t + 1, -look), (steps + 1 + i, look)], value[t, i], noise)
    cov = np.linalg.inv(information)
    return (cov @ right).reshape(-1, 2), cov


def test_linear_problem_is_solved_exactly():
    """With headings known, path, map and covariances are those of a dense linear smoother."""
    rng = np.random.default_rng(1)
    odometry, pose = drive(8, rng)
    r, b = seen_from(pose, WORLD)
    value = np.stack([r * np.cos(b), r * np.sin(b)], -1) + 0.3 * rng.normal(size=(8, 3, 2))
    params = params_of("position", err_rot=0.0, err_drift=0.0, floor_rot=0.0)
    noise, start_cov = np.array([[0.09, 0.02], [0.02, 0.06]]), np.diag([0.04, 0.09, 0.0])
    data = as_frames(odometry, value, np.array([0.09, 0.02, 0.06]))
    bent = pose + [0.3, -0.2, 0.0]
    got = refine(data, bent, np.full((8, 3), -1), np.zeros(3), start_cov, params, "position", True)
    mean, cov = smoothed(odometry, value, start_cov[:2, :2], params, noise)
    np.testing.assert_allclose(got.pose[:, :2], mean[1:9], atol=1e-6)
    np.testing.assert_allclose(got.mean, mean[9:], atol=1e-6)
    blocks = cov.reshape(12, 2, 12, 2)[np.arange(12), :, np.arange(12)]
    np.testing.assert_allclose(got.cov[:, :2, :2], blocks[1:9], atol=1e-6)
    flat = blocks[9:].reshape(3, 4)[:, [0, 1, 3]]
    np.testing.assert_allclose(got.landmark_cov, flat, atol=1e-6)
    assert got.converged
    assert got.rounds == 1


def problem_of_bearings(rng, steps=10):
    odometry, pose = drive(steps, rng)
    truth = pose + np.cumsum(rng.normal(size=(steps, 3)) * [0.03, 0.03, 0.02], 0)
    _, b = seen_from(truth, WORLD)
    b = wrap(b + 0.03 * rng.normal(size=b.shape))
    return as_frames(odometry, np.stack([b, 0 * b], -1)), pose


def test_bearings_reach_the_optimum_of_another_solver(x64):
    """The same cost, written down here, and the same optimum as `scipy.optimize.least_squares`."""
    data, pose = problem_of_bearings(np.random.default_rng(4))
    params = params_of("bearing", sigma_bearing=0.03, mount_x=0.2, mount_yaw=0.05)
    steps, cov = len(pose), np.diag([0.01, 0.01, 0.01])
    got = refine(data, pose, np.full((steps, 3), -1), np.zeros(3), cov, params, "bearing", True)

    def residuals(flat):
        path, point = flat[: 3 * steps + 3].reshape(-1, 3), flat[3 * steps + 3 :].reshape(-1, 2)
        o, before, after = data.odometry, path[:-1], path[1:]
        c, s = np.cos(before[:, 2]), np.sin(before[:, 2])
        dx, dy = after[:, 0] - before[:, 0], after[:, 1] - before[:, 1]
        heading = wrap(after[:, 2] - before[:, 2] - o.dtheta)
        floor = params.floor_tran**2 * o.duration
        drift = params.err_drift**2 * o.distance + params.floor_rot**2 * o.duration
        spin = params.err_rot**2 * o.turn
        side = o.dx**2 * (drift / 3 + spin / 3) + floor
        both = o.dx * (drift + spin) / 2
        slope = both / (drift + spin)
        c_, s_ = np.cos(after[:, 2]), np.sin(after[:, 2])
        sensor = after[:, :2] + 0.2 * np.stack([c_, s_], 1)
        seen = seen_from(np.column_stack([sensor, after[:, 2] + 0.05]), point)[1]
        return np.concatenate([
            path[0] / 0.1,
            (c * dx + s * dy - o.dx) / np.sqrt(params.err_tran**2 * o.distance + floor),
            heading / np.sqrt(drift + spin),
            (c * dy - s * dx - slope * heading) / np.sqrt(side - slope * both),
            wrap(data.measurements.value[..., 0] - seen).ravel() / 0.03,
        ])  # fmt: skip

    start = np.concatenate([np.zeros(3), got.pose.ravel(), got.mean.ravel()])
    start += 1e-2 * np.random.default_rng(0).normal(size=len(start))
    best = least_squares(residuals, start, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-12)
    np.testing.assert_allclose(got.pose.ravel(), best.x[3 : 3 * steps + 3], atol=1e-5)
    np.testing.assert_allclose(got.mean.ravel(), best.x[3 * steps + 3 :], atol=1e-5)
    whole = np.linalg.inv(best.jac.T @ best.jac)
    marginal = whole[: 3 * steps + 3, : 3 * steps + 3].reshape(steps + 1, 3, steps + 1, 3)
    at = np.arange(1, steps + 1)
    np.testing.assert_allclose(got.cov, marginal[at, :, at], rtol=1e-3, atol=1e-7)


def test_the_world_may_be_turned():
    """Turning and shifting the world turns and shifts the answer, covariances too."""
    data, pose = problem_of_bearings(np.random.default_rng(5))
    params = params_of("bearing", sigma_bearing=0.03, landmark_extent=0.02, outlier=0.01)
    landmark_id, angle, shift = np.full((len(pose), 3), -1), 2.5, np.array([30.0, -7.0])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    cov = np.diag([0.01, 0.02, 0.01])
    whole = np.eye(3)
    whole[:2, :2] = turn
    one = refine(data, pose, landmark_id, np.zeros(3), cov, params, "bearing", True)
    moved = np.column_stack([pose[:, :2] @ turn.T + shift, wrap(pose[:, 2] + angle)])
    start = np.append(shift, angle)
    two = refine(data, moved, landmark_id, start, whole @ cov @ whole.T, params, "bearing", True)
    np.testing.assert_allclose(two.pose[:, :2], one.pose[:, :2] @ turn.T + shift, atol=1e-5)
    np.testing.assert_allclose(wrap(two.pose[:, 2] - one.pose[:, 2] - angle), 0, atol=1e-5)
    np.testing.assert_allclose(two.mean, one.mean @ turn.T + shift, atol=1e-5)
    np.testing.assert_allclose(two.cov, whole @ one.cov @ whole.T, atol=1e-6)


def room(sensor, known, **changes):
    """A simulated room's log, frames, parameters, true path, and a path bent by 0.3 m."""
    log = planar.planar(
        "room", 2, length_m=40.0, rate_hz=2.5, landmarks=14, max_per_frame=6, **changes
    )
    params = default_params(sensor, log)
    association = "known" if known else "maximum_likelihood"
    data = frames_from_log(log, config_for(log, sensor, association, descriptors=0), params)
    true = log.truth.pose
    along = np.linspace(0, 3, len(true))
    bent = true + np.stack([0.3 * np.sin(along), 0.3 * (np.cos(along) - 1), 0.1 * np.sin(along)], 1)
    return log, data, params, true, bent


def births(log, data):
    """True associations as a lineage's births."""
    who = np.where(data.row >= 0, log.truth.identity[data.row], -9)
    landmark_id = np.where(who == -9, -3, -2)
    for i in np.unique(who[who >= 0]):
        place = np.flatnonzero(who.ravel() == i)
        landmark_id.ravel()[place] = place[0]
        landmark_id.ravel()[place[0]] = -1
    return landmark_id, who


@pytest.mark.parametrize("sensor", ["bearing", "range_bearing", "position"])
def test_a_bent_path_is_straightened(sensor):
    """From 0.3 m off to where the true path leads, clutter found, and as sure as it is right."""
    log, data, params, true, bent = room(sensor, False)
    landmark_id, who = births(log, data)
    got = refine(data, bent, landmark_id, log.start_pose, log.start_cov, params, sensor)
    best = refine(data, true, landmark_id, log.start_pose, log.start_cov, params, sensor)
    assert got.converged
    assert np.abs(wrap(got.pose - best.pose)).max() < 1e-4
    assert ate(got.pose, true)[0] < 0.05
    pairs = pair_by_distance(got.mean, log.truth.landmarks, 0.3)
    off = got.mean[pairs[:, 0]] - log.truth.landmarks[pairs[:, 1]]
    assert len(pairs) == len(got.mean) >= 12
    assert np.hypot(*off.T).max() < 0.2
    xx, xy, yy = got.landmark_cov[pairs[:, 0]].T
    square = yy * off[:, 0] ** 2 - 2 * xy * off[:, 0] * off[:, 1] + xx * off[:, 1] ** 2
    assert np.all(square / (xx * yy - xy**2) < chi2.ppf(0.9999, 2))
    error = got.pose - true
    error[:, 2] = wrap(error[:, 2])
    squared = np.einsum("ti,tij,tj->t", error, np.linalg.inv(got.cov), error)
    assert np.mean(squared < chi2.ppf(0.99, 3)) > 0.8
    assert 0.8 < got.residual < 1.1
    right = (got.landmark_id == -2) == (who == -1)
    assert right[who > -9].mean() > 0.98


def test_a_split_landmark_merges_and_one_of_clutter_leaves():
    log, data, params, _, bent = room("range_bearing", False)
    landmark_id, who = births(log, data)
    half = np.arange(len(who)) > len(who) // 2
    split = [np.flatnonzero((who == i).ravel() & np.repeat(half, who.shape[1])) for i in (0, 1)]
    for place in split:
        landmark_id.ravel()[place] = place[0]
        landmark_id.ravel()[place[0]] = -1
    noise = np.flatnonzero((who == -1).ravel())[:4]
    landmark_id.ravel()[noise[1:]] = noise[0]
    landmark_id.ravel()[noise[0]] = -1
    # and some clutter that the lineage called so, though it was none
    lost = np.flatnonzero((who == 3).ravel())[5:10]
    landmark_id.ravel()[lost] = -2
    got = refine(data, bent, landmark_id, log.start_pose, log.start_cov, params, "range_bearing")
    assert got.merged == 2
    assert got.dropped == 1
    assert len(got.mean) == len(np.unique(who[who >= 0]))
    assert noise[0] not in got.id
    label = got.landmark_id.ravel()[lost]
    assert len(np.unique(label)) == 1
    assert label[0] in got.id
    assert got.n.sum() == np.sum(got.landmark_id >= -1)


def test_wrong_identities_are_left_out():
    """Known identities: gross errors neither move the map nor count as used."""
    log, data, params, true, bent = room("bearing", True, outlier=0.0)
    rng = np.random.default_rng(0)
    value = data.measurements.value.copy()
    wrong = data.measurements.valid & (rng.random(value.shape[:2]) < 0.1)
    value[wrong, 0] = rng.uniform(-3, 3, wrong.sum())
    data = data._replace(measurements=data.measurements._replace(value=value))
    params = params._replace(outlier=0.05)
    none = np.full(wrong.shape, -1)
    got = refine(data, bent, none, log.start_pose, log.start_cov, params, "bearing", True)
    assert ate(got.pose, true)[0] < 0.05
    assert np.mean(got.landmark_id[wrong] == -2) > 0.85
    assert np.mean(got.landmark_id[data.measurements.valid & ~wrong] != -2) > 0.99
    assert (data.identities[got.identity] == log.truth.landmark_id[got.identity]).all()


def test_bearings_from_one_place_are_no_landmark():
    """Without parallax there is no depth: the landmark stays out, and nothing breaks."""
    odometry, _ = drive(6, np.random.default_rng(0))
    odometry = odometry._replace(dx=odometry.dx * 0, distance=odometry.dx * 0, turn=odometry.dx * 0)
    odometry = odometry._replace(dtheta=odometry.dx * 0)
    value = np.zeros((6, 1, 2)) + [0.4, 0]
    data, pose = as_frames(odometry, value), np.zeros((6, 3))
    params = params_of("bearing", sigma_bearing=0.03)
    got = refine(data, pose, np.full((6, 1), -1), np.zeros(3), None, params, "bearing", True)
    assert (len(got.mean), got.dropped, got.rounds) == (0, 1, 1)
    np.testing.assert_allclose(got.pose, 0, atol=1e-9)


@pytest.mark.parametrize("sensor", ["bearing", "range_bearing", "position"])
@pytest.mark.parametrize("kind", ["clutter", "padding", "one", "none"])
def test_nothing_to_go_by(sensor, kind):
    """No measurements, only clutter, one frame, no frame: the path is that of odometry."""
    steps = {"one": 1, "none": 0}.get(kind, 4)
    odometry, pose = drive(steps, np.random.default_rng(0))
    data = as_frames(odometry, np.ones((steps, 2, 2)), np.array([0.1, 0.0, 0.1]))
    if kind == "padding":
        nothing = data.measurements._replace(valid=np.zeros((steps, 2), bool))
        data = data._replace(measurements=nothing)
    landmark_id = np.full((steps, 2), -3 if kind == "padding" else -2)
    params = params_of(sensor, outlier=0.01)
    got = refine(data, pose, landmark_id, np.zeros(3), np.diag([0.1, 0.1, 0.0]), params, sensor)
    assert (len(got.mean), got.merged, got.converged) == (0, 0, True)
    np.testing.assert_allclose(got.pose, pose, atol=1e-6)
    assert got.landmark_id.tolist() == landmark_id.tolist()
    assert np.all(np.linalg.eigvalsh(got.cov) > 0)


def test_no_noise_at_all_is_no_error():
    """Variances of zero: fixed, not divided by."""
    odometry, pose = drive(4, np.random.default_rng(0))
    value = np.stack(seen_from(pose, WORLD), -1)
    params = params_of("range_bearing", err_tran=0.0, err_rot=0.0, err_drift=0.0)
    params = params._replace(floor_tran=0.0, floor_rot=0.0)
    data = as_frames(odometry, value)
    got = refine(data, pose, np.full((4, 3), -1), np.zeros(3), None, params, "range_bearing", True)
    np.testing.assert_allclose(got.mean, WORLD, atol=1e-6)
    assert np.all(np.isfinite(got.cov))
    assert got.converged


def test_arrays_that_do_not_fit_are_refused():
    odometry, pose = drive(4, np.random.default_rng(0))
    data = as_frames(odometry, np.ones((4, 2, 2)))
    params = params_of("range_bearing")
    with pytest.raises(ValueError, match=r"landmark_id: shape \(4, 3\), must be \(4, 2\)"):
        refine(data, pose, np.full((4, 3), -1), np.zeros(3), None, params, "range_bearing")
    with pytest.raises(ValueError, match="pose: not all finite"):
        refine(data, pose * np.nan, np.full((4, 2), -1), np.zeros(3), None, params, "bearing")


def test_the_cost_never_rises():
    log, data, params, _, bent = room("bearing", True)
    costs = []
    refine(
        data, bent, np.full(data.row.shape, -1), log.start_pose, log.start_cov, params, "bearing",
        True, progress=lambda count, cost: costs.append((count, cost)),
    )  # fmt: skip
    last = max(i for i, (count, _) in enumerate(costs) if count == 1)
    cost = np.array([c for _, c in costs[last:]])
    assert np.all(np.diff(cost) < 1e-3 * np.abs(cost).max())


def test_errors_that_stay_alike_count_less():
    """Standing still with correlated errors adds no certainty."""
    odometry, pose = drive(6, np.random.default_rng(0))
    value = np.stack(seen_from(pose, WORLD), -1)
    data = as_frames(odometry, value)
    sizes = []
    for correlation in (0.0, 1.0):
        params = params_of("range_bearing", correlation=correlation, outlier=0.01)
        with jax.enable_x64(True):
            given, _ = bundle.make_problem(data, np.zeros(3), None, params, "range_bearing")
        # A radian counts as a tenth of a metre.
        travel = odometry.distance + 0.1 * odometry.turn
        expected = np.tanh(travel / 2) if correlation else np.ones(6)
        np.testing.assert_allclose(given.tempering, expected[given.frame], rtol=1e-6)
        got = refine(
            data, pose, np.full((6, 3), -1), np.zeros(3), None, params, "range_bearing", True
        )
        sizes.append(got.landmark_cov[:, 0].sum())
    assert sizes[1] > 1.5 * sizes[0]
