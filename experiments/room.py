"""The paper's experiment on rendered images: round the room and back, both sensors, from images.

    python experiments/room.py                  three rooms, tables and figure (about 15 minutes)
    python experiments/room.py --ablation       what each part is worth, and each error model
    python experiments/room.py --seeds 101      one room

A straight calibration drive in another room gives the sensor's errors, as in the paper; then every
room is driven round three times (60 m, an image every 20 cm), its lines are extracted and matched,
and the log is filtered with identities hidden. Nothing is aligned: the start pose is given, as the
paper reads its errors off the floor's tiles. Writes experiments/results/room.md and docs/room.png,
points.png and lines.png.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from line_truth import CONTRAST, TALL, named

from calibration import sensor_report
from calibration.points import coverage, point_errors, with_model
from jaxslam import config_for, default_params, run
from jaxslam.evaluate import pair_by_distance, truth_at
from jaxslam.furnish import furnish
from jaxslam.render import double_mirror_camera, nominal, render_room
from jaxslam.room import visible_edges
from jaxslam.vision.camera_files import load_camera
from jaxslam.vision.extract import extract
from jaxslam.vision.images import read_image
from jaxslam.vision.lines import LineSettings, extract_lines
from jaxslam.vision.matching import MatchSettings
from jaxslam.vision.overlay import draw_lines, draw_on_image
from jaxslam.vision.panorama import panorama, unwrap
from jaxslam.vision.points import PointSettings

RESULTS = Path(__file__).parent / "results"
FIGURE = Path(__file__).parents[1] / "docs" / "room.png"
CALIBRATION = 100  # seed of the room of the straight drive
GATE = 0.15  # m, within which an edge counts as mapped
MOTION = ("gain_tran", "gain_rot", "err_tran", "err_rot", "err_drift")
OFTEN = 0.1  # of the frames in which a visible edge is in view


def rendered(folder, seed, drive, preset, length=None):
    """A folder with the images of a drive, rendered unless it is there already."""
    place = folder / f"{drive}-{seed}-{preset}"
    if not place.exists():
        print(f"rendering {place} ...", flush=True)
        render_room(place, seed=seed, drive=drive, preset=preset, length=length)
    return place


def extracted(place, camera, found, **settings):
    """The log of a folder of images; `found`: what is known of the robot's motion."""
    params = default_params("position")._replace(**found)
    return extract(
        place / "images", camera, place / "odometry.csv", truth=place, params=params, **settings
    )


def calibrated(folder, camera, preset):
    """What the paper's procedure finds: the robot's motion, and the report of the straight drive.

    One round of the room gives the errors of the motion, turns included; a straight drive past
    surveyed lines then those of the points. Every edge of that room is surveyed.
    """
    found = {}
    for drive, length in (("loop", 20.0), ("straight", 7.5)):
        place = rendered(folder, CALIBRATION, drive, preset, length)
        edges = furnish(CALIBRATION).edges.point
        log = extracted(place, camera, found)
        truth = replace(log.truth, landmarks=edges, landmark_id=np.arange(len(edges)))
        log = replace(log, truth=truth)
        report = sensor_report.calibrate_sensor(log)
        values = sensor_report.values(report)[0]
        found = {name: values[name] for name in MOTION if name in values} | found
    return found, report, log


def edges_in_view(seed, log):
    """Points of the edges that a map should have, and of all edges there are.

    Landmarks (0.4 m tall) that show at least 10 degrees of themselves, with contrast, in a tenth
    of the frames; by the room's geometry alone.
    """
    world = furnish(seed)
    count = np.zeros(len(world.edges.point), int)
    poses = truth_at(log.truth, log.frame_time)
    for pose in poses:
        seen = visible_edges(world, pose)
        clear = (seen.contrast > CONTRAST) & (seen.high - seen.low > TALL)
        count[seen.id[clear]] += 1
    wanted = world.edges.landmark & (count >= OFTEN * len(poses))
    return world.edges.point[wanted], world.edges.point


def score(result, seed, log):
    """Errors of a run against truth and floor plan, nothing aligned."""
    true = truth_at(log.truth, result.time)
    off = np.hypot(*(result.pose - true)[:, :2].T)
    wanted, every = edges_in_view(seed, log)
    mean = result.landmarks.mean
    pairs = pair_by_distance(mean, every, GATE)
    error = np.hypot(*(mean[pairs[:, 0]] - every[pairs[:, 1]]).T)
    nearest = np.hypot(*(mean[:, None] - every).transpose(2, 0, 1)).min(axis=1)
    mapped = pair_by_distance(mean, wanted, GATE)
    return {
        "path_m": float(np.sqrt(np.mean(off**2))),
        "path_max_m": float(off.max()),
        "reckoning_m": float(
            np.sqrt(np.mean(np.sum((result.dead_reckoning - true)[:, :2] ** 2, 1)))
        ),
        "landmarks_m": float(np.sqrt(np.mean(error**2))) if len(error) else np.nan,
        "landmark_max_m": float(nearest.max()) if len(nearest) else np.nan,
        "edges": len(wanted),
        "mapped": len(mapped),
        "landmarks": len(mean),
        "spurious": len(mean) - len(pairs),
        "in_95": points_covered(log, seed),
        "frames": len(log.frame_time),
        "measurements": len(log.frame),
    }


def points_covered(log, seed):
    """Share of the triangulated points within their own 95 % ellipse about the true edge."""
    truth = replace(log.truth, landmarks=furnish(seed).edges.point, landmark_id=None)
    return coverage(point_errors(replace(log, truth=truth), log.noise["gain_tran"]))


COLUMNS = (
    ("path_m", "path RMSE [m]", "{:.3f}"),
    ("path_max_m", "path, most [m]", "{:.3f}"),
    ("landmarks_m", "landmarks RMSE [m]", "{:.3f}"),
    ("landmark_max_m", "landmark, most [m]", "{:.2f}"),
    ("edges", "edges in view", "{}"),
    ("mapped", "mapped", "{}"),
    ("spurious", "spurious", "{}"),
    ("in_95", "points in 95 %", "{:.3f}"),
    ("reckoning_m", "dead reckoning [m]", "{:.2f}"),
)


def table(rows):
    """Markdown of [(name, scores)]."""
    lines = ["| case | " + " | ".join(title for _, title, _ in COLUMNS) + " |"]
    lines.append("|---" * (len(COLUMNS) + 1) + "|")
    for name, found in rows:
        cells = [form.format(found[key]) for key, _, form in COLUMNS]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def filtered(log, sensor, particles, seed):
    config = config_for(log, sensor, particles=particles, landmarks=192)
    return run(log, config, default_params(sensor, log), seed)  # the log declares the motion


def draw(result, seed, path):
    """The paper's figs. 12, 13 and 14 side by side: plan with tiles, positions, map and paths."""
    import matplotlib
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    from jaxslam.plot import STYLE, write_figure

    log = result.log
    true = truth_at(log.truth, result.time)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10, 13), layout="constrained")
        titles = ("Floor plan, 30 cm tiles", "Positions (circles) and map (plus signs)",
                  "True path (line), estimated path (dotted), map (plus signs)")  # fmt: skip
        for i, (axes, title) in enumerate(zip(figure.subplots(3, 1), titles, strict=True)):
            walls = log.plan.segments.reshape(-1, 2, 2)
            axes.add_collection(LineCollection(walls, colors="#444444", linewidths=1.6))
            axes.set(xlim=(-0.2, 10.2), ylim=(-0.2, 4.2), aspect="equal", title=title)
            axes.set_xticks(np.arange(0, 10.1, 0.3), minor=True)
            axes.set_yticks(np.arange(0, 4.1, 0.3), minor=True)
            axes.grid(False)
            axes.grid(which="minor", color="#DDDDDD", lw=0.5)
            if i == 0:
                axes.plot(*furnish(seed).edges.point.T, ".", ms=3, color="#444444")
            if i == 1:
                axes.plot(*result.pose[:, :2].T, "o", ms=5, mfc="none", mec="#E69F00", mew=0.9)
            if i == 2:
                axes.plot(*true[:, :2].T, "-", color="#222222", lw=0.9)
                axes.plot(*result.pose[:, :2].T, ":", color="#0072B2", lw=1.4)
            if i:
                axes.plot(*result.landmarks.mean.T, "+", ms=8, mew=1.5, color="#D55E00")
        axes.set(xlabel="x [m]", ylabel="y [m]")
        write_figure(figure, path)


def draw_lines_found(place, camera, path):
    """An image of the drive and its panorama, with the lines drawn in, one above the other."""
    image = read_image(place / "images" / "000010.png")
    lines, view = extract_lines(image, camera), panorama(camera)
    strip = draw_lines(unwrap(image, view), lines, view)
    pair = np.hstack([image, draw_on_image(image, lines, camera)])
    wide, tall = strip.shape[1], round(pair.shape[0] * strip.shape[1] / pair.shape[1])
    both = np.vstack([cv2.resize(pair, (wide, tall), interpolation=cv2.INTER_AREA), strip])
    both = cv2.resize(both, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA)
    if not cv2.imwrite(str(path), both):
        raise ValueError(f"{path}: can't be written")


def ablated(camera):
    """Name -> camera and settings of the extraction, one part left out each."""
    flat = nominal(camera)
    blind = PointSettings(matching=MatchSettings(use_colour=False))
    return {
        "all parts": (camera, {}),
        "calibration off": (replace(flat, roll=camera.roll, pitch=camera.pitch), {}),
        "tilt off": (replace(camera, roll=0.0, pitch=0.0), {}),
        "colour off": (camera, {"lines": LineSettings(colour=False), "points": blind}),
        "merging off": (camera, {"lines": LineSettings(merge=False)}),
    }


def one_best(log):
    """The log with the surest point of every frame alone, as with one measurement per step."""
    size = np.where(np.isfinite(log.point_cov[:, 0]), log.point_cov[:, [0, 2]].sum(1), np.inf)
    best = [rows[np.argmin(size[rows])] for rows in _rows_of_frames(log) if len(rows)]
    kept = np.isin(np.arange(len(size)), best)[:, None] & np.isfinite(size)[:, None]
    base = np.where(kept[:, 0], log.point_baseline, np.nan)
    return replace(log, point=np.where(kept, log.point, np.nan), point_baseline=base,
                   point_cov=np.where(kept, log.point_cov, np.nan))  # fmt: skip


def _rows_of_frames(log):
    return np.split(np.arange(len(log.frame)), np.flatnonzero(np.diff(log.frame)) + 1)


def line_scores(log, seed):
    """RMS error of the lines' bearings [deg], and false lines a frame, of every fifth frame."""
    world, poses = furnish(seed), truth_at(log.truth, log.frame_time)
    errors, false, frames = [], 0, 0
    for k in range(0, len(poses), 5):
        _, error, wrong, _ = named(log.bearing[log.frame == k], world, poses[k])
        errors.append(error[np.isfinite(error)])
        false, frames = false + wrong.sum(), frames + 1
    return np.degrees(np.sqrt(np.mean(np.concatenate(errors) ** 2))), false / frames


def ablation(folder, camera, found, seed, particles, preset):
    """Markdown: what the lines and the path lose without each part."""
    place = rendered(folder, seed, "loop", preset)
    lines = ["| room " + str(seed) + " | bearing, RMS | false lines a frame | path RMSE [m] "
             "| path, most [m] | mapped | spurious |", "|---" * 7 + "|"]  # fmt: skip
    logs = {name: extracted(place, eye, found, **settings)
            for name, (eye, settings) in ablated(camera).items()}  # fmt: skip
    logs["one measurement per step"] = one_best(logs["all parts"])
    for name, log in logs.items():
        error, false = line_scores(log, seed)
        got = score(filtered(log, "position", particles, seed), seed, log)
        cells = f"{error:.3f}° | {false:.2f} | {got['path_m']:.3f} | {got['path_max_m']:.2f}"
        mapped = f"{got['mapped']} of {got['edges']}"
        lines.append(f"| {name} | {cells} | {mapped} | {got['spurious']} |")
        print(lines[-1], flush=True)
    return "\n".join(lines)


def models_in_the_filter(report, log, seed, particles):
    """Markdown: the candidates for a point's error, by held-out density and through the filter."""
    lines = ["| error model of a point | nats per held-out point | in 95 % | path RMSE [m] "
             "| landmarks RMSE [m] | mapped | spurious |", "|---" * 7 + "|"]  # fmt: skip
    for model in report.models:
        got = score(filtered(with_model(model, log), "position", particles, seed), seed, log)
        told = f"{model.held_out:.2f} | {100 * model.coverage:.0f} %"
        cells = f"{got['path_m']:.3f} | {got['landmarks_m']:.3f} | {got['mapped']}"
        lines.append(f"| {model.name} | {told} | {cells} | {got['spurious']} |")
        print(lines[-1], flush=True)
    return "\n".join(lines)


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--seeds", type=int, nargs="+", default=[101, 102, 103])
    options.add_argument("--draws", type=int, nargs="+", default=[0, 1, 2], help="filter's seeds")
    options.add_argument("--particles", type=int, default=1000)
    options.add_argument("--preset", default="normal")
    options.add_argument("--folder", type=Path, default=Path("runs/rooms"))
    options.add_argument("--ablation", action="store_true")
    options = options.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    RESULTS.mkdir(exist_ok=True)
    camera = double_mirror_camera()
    found, report, straight = calibrated(options.folder, camera, options.preset)
    print(sensor_report.text(report))
    first = options.seeds[0]
    if options.ablation:
        parts = ablation(options.folder, camera, found, first, options.particles, options.preset)
        place = rendered(options.folder, first, "loop", options.preset)
        log = extracted(place, camera, found)
        models = models_in_the_filter(report, log, first, options.particles)
        (RESULTS / "room-ablation.md").write_text(parts + "\n\n" + models + "\n")
        return
    sensor_report.draw(report, straight, FIGURE.with_name("points.png"))
    rows = []
    for seed in options.seeds:
        place = rendered(options.folder, seed, "loop", options.preset)
        log = extracted(place, load_camera(place / "camera.toml"), found)
        if seed == first:
            draw_lines_found(place, camera, FIGURE.with_name("lines.png"))
        runs = [("position", draws) for draws in options.draws] + [("bearing", options.draws[0])]
        for sensor, draws in runs:
            result = filtered(log, sensor, options.particles, draws)
            rows.append((f"{sensor}, room {seed}, run {draws}", score(result, seed, log)))
            print(table(rows[-1:]).splitlines()[-1], flush=True)
            if (sensor, seed, draws) == ("position", first, options.draws[0]):
                draw(result, seed, FIGURE)
    rows.sort(key=lambda row: row[0].startswith("bearing"))
    (RESULTS / "room.md").write_text(table(rows) + "\n")
    (RESULTS / "room.json").write_text(json.dumps(dict(rows), indent=1) + "\n")


if __name__ == "__main__":
    main()
