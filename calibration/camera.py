"""Calibration of a camera from images of a chessboard: `calibrate_camera`.

Corners -> an initial solution by linear equations -> bundle adjustment of a growing model, from the
two lowest terms of the polynomial upwards (starting at full order diverges) -> outlier corners
removed and localised again -> covariance, coverage and bearing uncertainty. The order is the one
that best predicts the corners of held-out boards: corner errors are correlated within a board, so
BIC, which assumes independence, selects too high an order.
"""

import math
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from calibration.bundle import OUTLIER, Corners, Solution, adjust, free_directions, robust_scale
from calibration.corners import VARIANTS, board_points, check_board, find_again, find_views
from calibration.coverage import Bearings, Coverage, bearing_uncertainty, coverage, list_warnings
from calibration.initial import first_solution
from jaxslam.vision.camera import Camera, parameter_names

LEAST_BOARDS, LEAST_CORNERS = 3, 8
ORDERS = (4, 5, 6)
WORST = 1.0  # deg: a calibration with a larger uncertainty of bearings is rejected
START = ("a0", "a2", "cx", "cy"), ("a3", "a4"), ("c", "e", "p1", "p2")
UNDETERMINED = "the boards don't determine the camera: place and tilt them differently"
NOT_SIMPLE = {"polynomial": ("p1", "p2"), "unified": ("s",)}


@dataclass(frozen=True, eq=False)
class Calibration:
    """A camera, and the data that support it. Residuals are in px, of all corners with outliers."""

    camera: Camera
    solution: Solution
    corners: Corners
    names: list  # of the images used, one per board
    rejected: list  # (name, reason)
    order: int | None
    scores: dict  # order -> (RMS px, RMS px of held-out boards, NaN if not tried)
    variant: str  # how the corners were localised
    again: int  # outlier corners that were localised again
    coverage: Coverage
    bearings: Bearings
    warnings: list

    @property
    def mean(self):
        return float(self.solution.distance.mean())

    @property
    def rms(self):
        return self.solution.rms

    @property
    def per_image(self):
        """(name, number of corners, mean, RMS and largest residual px) of each image."""
        rows = []
        for b, name in enumerate(self.names):
            d = self.solution.distance[self.corners.board == b]
            rows.append((name, len(d), d.mean(), math.sqrt(np.mean(d**2)), d.max()))
        return rows

    @property
    def outliers(self):
        """(name, index of the corner on its board, residual px) of the outliers."""
        start = np.searchsorted(self.corners.board, self.corners.board)
        return [
            (self.names[self.corners.board[i]], int(i - start[i]), float(self.solution.distance[i]))
            for i in np.flatnonzero(self.solution.weight == 0)
        ]


@contextmanager
def _explain_singular():
    """Translate a singular matrix, which degenerate boards cause, into a `ValueError`."""
    try:
        yield
    except np.linalg.LinAlgError:
        raise ValueError(UNDETERMINED) from None


@_explain_singular()
def calibrate_camera(
    source, board=(6, 7), square=0.03, model="polynomial", mirror=False, lens="up", order=None,
    simple=False, progress=None,
):  # fmt: skip
    """Calibrate a camera from images (folder, pattern or list) of a chessboard: `Calibration`.

    `board`: inner corners (per row, per column); `square` m; `order` of the polynomial: 4 to 6, or
    None to select it. `simple`: without decentring (polynomial) or skew (unified), which other
    tools' files can't hold. `progress(done, total)` in images. Raises `ValueError` if too few
    boards are usable or they don't determine the camera.
    """
    check_board(board, square)
    views = find_views(source, board, progress)
    _check_count(len(views.names), views.rejected)
    points = board_points(board, square)
    trials = []
    for variant in VARIANTS:
        corners = _gather(views.corners[variant], points, views.size, views.names)[1]
        solution = _highest_order(_fit_orders(corners, model, order, simple))
        rms = math.sqrt(np.mean(solution.distance[solution.weight > 0] ** 2))  # of the inliers
        trials.append((rms, variant, corners, solution))
    _, variant, corners, solution = min(trials, key=lambda trial: trial[0])
    pixels, again = _find_outliers_again(views.files, corners, solution, board)
    result = calibrate_corners(
        pixels, points, views.size, model, mirror, lens, order, simple, views.names
    )
    return replace(result, variant=variant, again=again, rejected=views.rejected + result.rejected)


@_explain_singular()
def calibrate_corners(
    pixels, points, size, model="polynomial", mirror=False, lens="up", order=None, simple=False,
    names=None,
):  # fmt: skip
    """Calibrate a camera from corners: `Calibration`.

    `pixels`: a list of [n, 2] px, one per board; `points`: [n, 2] m on the board, one array for all
    or a list; boards may be partial. `size`: (width, height) px. Otherwise as `calibrate_camera`.
    """
    if model == "polynomial" and order not in (None, *ORDERS):
        raise ValueError(f"order {order!r} of the polynomial: must be 4, 5 or 6")
    names = [f"board {i}" for i in range(len(pixels))] if names is None else list(names)
    names, corners, rejected = _gather(pixels, points, size, names)
    fits = _fit_orders(corners, model, order, simple)
    misfit = _find_misfits(corners, _highest_order(fits))
    if misfit:
        why = "half of its corners are outliers: another board, or corners in a wrong order"
        rejected += [(names[b], why) for b in misfit]
        kept = [b for b in range(corners.boards) if b not in misfit]
        names, corners = [names[b] for b in kept], corners.of_boards(kept)
        _check_count(len(names), rejected)
        fits = _fit_orders(corners, model, order, simple)
    order, scores = _choose_order(corners, fits, model, order, simple)
    solution = fits[order]
    camera = _make_camera(solution, corners, model, mirror, lens)
    cover = coverage(camera, corners, _board_distances(corners, solution))
    uncertain = bearing_uncertainty(camera, cover.radius)
    doubts = list_warnings(corners, names, cover, uncertain)
    _check_bearings(cover, uncertain, doubts)
    order = order if model == "polynomial" else None
    scores = {key: (fit.rms, scores.get(key, math.nan)) for key, fit in fits.items()}
    return Calibration(
        camera, solution, corners, names, rejected, order, scores, variant="given", again=0,
        coverage=cover, bearings=uncertain, warnings=doubts,
    )  # fmt: skip


def cross_validate(corners, fits, model, order=None, simple=False, folds=2):
    """Predict held-out boards by cameras fitted to the others: {order: residual lengths [n] px}.

    `fits`: {order: `Solution`} of all boards. The poses of held-out boards are estimated with the
    camera fixed. `order`: the highest of the polynomial.
    """
    length = {key: np.empty(len(corners.pixel)) for key in fits}
    for fold in range(folds):
        out = np.arange(corners.boards) % folds == fold
        fitted, held_out = (corners.of_boards(np.flatnonzero(part)) for part in (~out, out))
        cameras = _fit_orders(fitted, model, order, simple)
        for key, fit in fits.items():
            start = Solution(cameras[key].params, fit.rotation[out], fit.translation[out])
            predicted = adjust(model, held_out, start, free_directions(model, ()))
            length[key][out[corners.board]] = predicted.distance
    return length


def _choose_order(corners, fits, model, order, simple):
    """The selected order, and {order: RMS px on held-out boards}, without outliers."""
    default = list(fits)[-1] if order or model == "unified" else next(iter(fits))
    if corners.boards < 2 * LEAST_BOARDS:
        return default, {}
    good = _highest_order(fits).weight > 0
    lengths = cross_validate(corners, fits, model, order, simple)
    scores = {key: math.sqrt(np.mean(d[good] ** 2)) for key, d in lengths.items()}
    return (default if order else min(scores, key=scores.get)), scores


def _gather(pixels, points, size, names):
    """Names and `Corners` of the usable boards, and (name, reason) of the others."""
    if len(pixels) != len(names):
        raise ValueError(f"{len(pixels)} boards but {len(names)} names")
    common = not isinstance(points, (list, tuple))
    kept, rejected = [], []
    for i, (name, pixel) in enumerate(zip(names, pixels, strict=True)):
        pixel = np.asarray(pixel, float)
        point = np.asarray(points if common else points[i], float)
        fault = _find_fault(pixel, point, size)
        if fault:
            rejected.append((name, fault))
        else:
            kept.append((name, pixel, point))
    _check_count(len(kept), rejected)
    names, pixels, points = zip(*kept, strict=True)
    board = np.repeat(np.arange(len(kept)), [len(p) for p in pixels])
    corners = Corners(np.concatenate(pixels), np.concatenate(points), board, tuple(map(int, size)))
    return list(names), corners, rejected


def _find_fault(pixel, point, size):
    """The reason why a board's corners can't be used, or None."""
    if pixel.shape != point.shape or pixel.ndim != 2 or pixel.shape[1] != 2:
        return f"{len(pixel)} corners for {len(point)} points of the board"
    if not (np.isfinite(pixel).all() and np.isfinite(point).all()):
        return "its corners are not finite"
    if len(pixel) < LEAST_CORNERS:
        return f"{len(pixel)} corners; must be {LEAST_CORNERS} or more"
    spread = np.linalg.svd(point - point.mean(0), compute_uv=False)
    if spread[1] < 1e-3 * spread[0]:
        return "its points lie on one line"
    if (pixel < -0.5).any() or (pixel > np.array(size) - 0.5).any():
        return f"corners outside the image of {size[0]} x {size[1]}"
    return None


def _check_count(count, rejected):
    """Raise `ValueError` for too few boards."""
    if count < LEAST_BOARDS:
        why = f"; {rejected[0][0]}: {rejected[0][1]}" if rejected else ""
        raise ValueError(f"{count} usable boards; must be {LEAST_BOARDS} or more{why}")


def _fit_order_4(corners, simple):
    """Fit the polynomial of order 4 with affine map and decentring; `Solution`, names of params."""
    solution, names = first_solution(corners), []
    solution = adjust("polynomial", corners, solution, free_directions("polynomial", ()), steps=10)
    for added in START:
        names += [name for name in added if not (simple and name in NOT_SIMPLE["polynomial"])]
        solution = adjust("polynomial", corners, solution, free_directions("polynomial", names))
    return _refit_without_outliers("polynomial", corners, solution), names


def _fit_orders(corners, model, order, simple):
    """Fit all orders up to `order` (None: all): {order: `Solution`}, or {"unified": ...}."""
    solution, names = _fit_order_4(corners, simple)
    if model == "unified":
        return {model: _fit_unified(corners, solution, simple)}
    fits = {4: solution}
    for higher in range(5, (order or max(ORDERS)) + 1):
        names = [*names, f"a{higher}"]
        start = replace(solution, weight=None)
        solution = adjust(model, corners, start, free_directions(model, names))
        fits[higher] = solution = _refit_without_outliers(model, corners, solution)
    return fits


def _fit_unified(corners, polynomial, simple):
    """Fit the unified model, from a parabolic mirror (xi = 1) that agrees at the centre."""
    params = np.zeros(len(parameter_names("unified")))
    focal = polynomial.params[7] * max(corners.size)  # xi = 1: z = (f^2 - rho^2) / (2 f)
    params[:6] = *polynomial.params[:2], focal, focal, 0, 1
    start = replace(polynomial, params=params, weight=None)
    final = [n for n in parameter_names("unified") if not (simple and n in NOT_SIMPLE["unified"])]
    for names in (("fx", "fy"), ("fx", "fy", "cx", "cy", "xi"), final):
        start = adjust("unified", corners, start, free_directions("unified", names))
    return _refit_without_outliers("unified", corners, start)


def _refit_without_outliers(model, corners, solution):
    """Exclude outliers and adjust the solution again, until the outliers stay the same."""
    for _ in range(5):
        scale = robust_scale(solution.distance[solution.weight > 0])
        weight = (solution.distance < OUTLIER * scale).astype(float)
        if (weight == solution.weight).all():
            break
        solution = adjust(model, corners, replace(solution, weight=weight), solution.free)
    return solution


def _highest_order(fits):
    """The `Solution` of the highest order."""
    return list(fits.values())[-1]


def _board_distances(corners, solution):
    """Distances [B] m of the boards, each of the mean of its detected corners."""
    middle = [corners.point[corners.board == b].mean(0) for b in range(corners.boards)]
    arm = np.einsum("bij,bj->bi", solution.rotation[..., :2], middle)
    return np.linalg.norm(arm + solution.translation, axis=1)


def _find_misfits(corners, solution):
    """Indices of the boards of whose corners at least half are outliers."""
    bad = np.bincount(corners.board, solution.weight == 0) / np.bincount(corners.board)
    return np.flatnonzero(bad >= 0.5).tolist()


def _find_outliers_again(files, corners, solution, board):
    """Localise outliers again near their predictions: pixels of every board, number replaced."""
    pixels, again = [], 0
    for b, file in enumerate(files):
        own = corners.board == b
        pixel, lost = corners.pixel[own].copy(), solution.weight[own] == 0
        if 0 < lost.sum() < 0.5 * len(lost):
            predicted = pixel + solution.residual[own]
            pixel[lost] = find_again(file, predicted, board)[lost]
            again += int(lost.sum())
        pixels.append(pixel)
    return pixels, again


def _make_camera(solution, corners, model, mirror, lens):
    """`Camera` with the covariance of its parameters and the elevations covered by the boards."""
    information, good = solution.information, solution.weight > 0
    degrees = 2 * good.sum() - solution.free.shape[1] - 6 * corners.boards
    variance = np.sum(solution.distance[good] ** 2) / max(degrees, 1)
    size = np.sqrt(np.diagonal(information))
    scaled = information / np.outer(size, size)
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > 1e13:
        raise ValueError(UNDETERMINED)
    covariance = variance * np.linalg.inv(scaled) / np.outer(size, size)
    covariance = solution.free @ covariance @ solution.free.T
    count = len(solution.params)
    if model == "polynomial":  # an order below 6 ends early
        count = 1 + int(np.flatnonzero(solution.free.any(1))[-1])
    params, covariance = solution.params[:count], covariance[:count, :count]
    camera = Camera(*corners.size, model, params, mirror, lens, covariance=covariance)
    high = np.arcsin(camera.direction(corners.pixel)[:, 2].clip(-1, 1))
    return replace(camera, elevation=(float(high.min()), float(high.max())))


def _check_bearings(cover, uncertain, doubts):
    """Raise `ValueError` for boards that leave the bearings too uncertain."""
    why = "".join(f"; {warning}" for warning in doubts)
    if cover.gap > np.radians(240):
        covered = 360 - np.degrees(cover.gap)
        raise ValueError(f"all corners lie within {covered:.0f}° of azimuth{why}")
    if not uncertain.rms_deg < WORST:
        error = f"{uncertain.rms_deg:.2g}° (more than {WORST:g}°)"
        raise ValueError(f"the boards leave the bearings uncertain by {error}{why}")
