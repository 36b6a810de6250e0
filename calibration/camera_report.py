"""Report of a camera calibration: a text for the terminal, and a picture."""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from calibration.coverage import RINGS, SECTORS
from jaxslam.plotting import FILTER, LANDMARK, PLAN, RECKONING, STYLE, TRUE, write_figure

LONGEST = 0.06  # of the image's width, the arrow of the largest residual without outliers


def text(fit):
    """Residuals of every image, rejected images, coverage, bearing uncertainty, and warnings."""
    camera, bearings = fit.camera, fit.bearings
    model = camera.model + (f" of order {fit.order}" if fit.order else "")
    model += f", {camera.width} x {camera.height}"
    boards = f"{len(fit.corners.pixel)} corners of {len(fit.names)} boards ({fit.variant})"
    lines = [f"{model}: {boards}", "", *_residuals(fit), *_rejected(fit), ""]
    lines += [*_coverage(fit.coverage), "", *_orders(fit), ""]
    low, high = np.degrees(camera.elevation)
    uncertain = f"{bearings.rms_deg:.3f}° RMS, {bearings.max_deg:.3f}° at most"
    covered = f"elevations covered: {low:.1f}° to {high:.1f}°"
    lines.append(f"bearing uncertainty (1 sigma): {uncertain}; {covered}")
    return "\n".join(lines + [f"warning: {warning}" for warning in fit.warnings])


def _residuals(fit):
    width = max(len(name) for name in [*fit.names, "image"])
    lines = [f"{'image':{width}}  corners  mean   RMS  largest [px]"]
    for name, count, mean, rms, most in fit.per_image:
        lines.append(f"{name:{width}}  {count:7} {mean:5.3f} {rms:5.3f}  {most:7.2f}")
    count, most = len(fit.solution.distance), fit.solution.distance.max()
    lines.append(f"{'all':{width}}  {count:7} {fit.mean:5.3f} {fit.rms:5.3f}  {most:7.2f}")
    return lines


def _rejected(fit):
    lines = [f"{fit.again} outlier corners were localised again"] if fit.again else []
    for name, index, distance in fit.outliers:
        lines.append(f"outlier excluded: {name}, corner {index}: {distance:.1f} px")
    return lines + [f"rejected: {name}: {reason}" for name, reason in fit.rejected]


def _orders(fit):
    lines = ["order    RMS [px]  on held-out boards"]
    for order, (rms, held_out) in fit.scores.items():
        score = f"{held_out:.4f}" if np.isfinite(held_out) else "too few boards"
        lines.append(f"{order:7}  {rms:8.4f}  {score}{' <' * (order == fit.order)}")
    return lines


def _coverage(cover):
    step, ring = 360 // SECTORS, cover.radius[1] / RINGS
    lines = ["corners by radius [px] (rows) and direction in the image [°, clockwise from right]"]
    lines.append("        " + "".join(f"{-180 + step * i:5}" for i in range(SECTORS)))
    for i in reversed(range(RINGS)):
        counts = "".join(f"{n or '.':>5}" for n in cover.count[i].tolist())
        lines.append(f"{f'{i * ring:.0f}-{(i + 1) * ring:.0f}':>8}{counts}")
    return lines


def draw(fit, path):
    """Write the picture: residuals, coverage, radial function, uncertainty of bearings."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(12, 9.4), layout="constrained")
        (residuals, cover), (radial, bearing) = figure.subplots(2, 2)
        _draw_residuals(residuals, fit)
        _draw_coverage(cover, fit)
        _draw_radial(radial, fit)
        _draw_bearings(figure, bearing, fit)
        return write_figure(figure, Path(path))


def _image_axes(axes, camera, title):
    width, height = camera.size
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="u [px]", ylabel="v [px]")
    axes.set_aspect("equal")
    axes.set_title(title)
    axes.plot(*camera.params[:2], "+", ms=10, mew=1.6, color=TRUE, label="centre")


def _draw_residuals(axes, fit):
    pixel, residual = fit.corners.pixel, fit.solution.residual
    good = fit.solution.weight > 0
    longest = fit.solution.distance[good].max()
    scale = longest / (LONGEST * fit.camera.width)
    title = f"residuals, {1 / scale:.0f} times: mean {fit.mean:.3f}, RMS {fit.rms:.3f} px"
    _image_axes(axes, fit.camera, title)
    axes.quiver(
        *pixel[good].T, *residual[good].T, color=FILTER, angles="xy", scale_units="xy",
        scale=scale, width=0.0018, headwidth=4,
    )  # fmt: skip
    if not good.all():
        axes.plot(*pixel[~good].T, "x", color=LANDMARK, label="outlier, excluded")
    axes.legend(loc="lower right")


def _draw_coverage(axes, fit):
    cover, colours = fit.coverage, matplotlib.colormaps["viridis"]
    title = f"coverage: largest gap in azimuth {np.degrees(cover.gap):.0f}°"
    _image_axes(axes, fit.camera, title)
    centre, angle = fit.camera.params[:2], np.linspace(0, 2 * np.pi, 181)
    for i in range(1, RINGS + 1):
        circle = i * cover.radius[1] / RINGS * np.stack([np.cos(angle), np.sin(angle)])
        axes.plot(*(centre[:, None] + circle), color=PLAN, lw=0.7)
    for b in range(fit.corners.boards):
        own = fit.corners.pixel[fit.corners.board == b]
        axes.plot(*own.T, ".", ms=4, color=colours(b / max(fit.corners.boards - 1, 1)))
    ring, sector = np.nonzero(cover.count == 0)  # where boards are missing
    rho = (ring + 0.5) * cover.radius[1] / RINGS
    around = -np.pi + (sector + 0.5) * 2 * np.pi / SECTORS
    spots = centre + np.stack([rho * np.cos(around), rho * np.sin(around)], 1)
    axes.plot(*spots.T, "x", color=LANDMARK, ms=5, label="no corner")
    axes.legend(loc="lower right")


def _draw_radial(axes, fit):
    """Draw the angle from the axis over radius, and standard deviations of both angles."""
    camera, (low, high) = fit.camera, fit.coverage.radius
    rho = np.linspace(0, max(camera.size) / 2, 200)
    ray = camera.ray(camera.params[:2] + np.stack([rho, 0 * rho], 1))
    axes.axvspan(low, high, color="#F0F4F8", label="covered by corners")
    axes.plot(rho, np.degrees(np.arccos(ray[:, 2])), color=TRUE, label="angle from the axis")
    axes.set(xlabel="radius [px]", ylabel="angle from the axis [°]")
    axes.set(xlim=(0, rho[-1]), ylim=(0, None))
    axes.set_title("radial function and its uncertainty")
    right = axes.twinx()
    at = np.hypot(*(fit.bearings.pixel - camera.params[:2]).T)[0]
    azimuth = "azimuth", FILTER, fit.bearings.sigma
    polar = "angle from the axis", RECKONING, fit.bearings.polar
    for name, colour, sigma in (azimuth, polar):
        known = np.isfinite(sigma).any(1)
        squared = np.nanmean(np.degrees(sigma[known]) ** 2, axis=1)
        right.plot(at[known], np.sqrt(squared), color=colour, ls="--", label=rf"$\sigma$ of {name}")
    right.set(ylabel=r"$\sigma$ [°], mean over azimuth", ylim=(0, None))
    right.grid(False)
    handles = [*axes.get_legend_handles_labels()[0], *right.get_legend_handles_labels()[0]]
    axes.legend(handles=handles, loc="lower right")


def _draw_bearings(figure, axes, fit):
    bearings = fit.bearings
    title = f"σ of azimuth: {bearings.rms_deg:.3f}° RMS, {bearings.max_deg:.3f}° at most"
    _image_axes(axes, fit.camera, title)
    x, y = np.moveaxis(np.concatenate([bearings.pixel, bearings.pixel[:, :1]], 1), -1, 0)
    sigma = np.degrees(bearings.sigma[:-1])  # of a cell's first corner
    mesh = axes.pcolormesh(x, y, sigma, cmap="viridis", vmin=0)
    figure.colorbar(mesh, ax=axes, label="σ of azimuth [°]", shrink=0.8)
