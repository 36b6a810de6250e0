"""The paper's experiment on rendered images: round the room and back, both sensors, from images.

    python experiments/room.py                  three rooms, tables and figure (about half an hour)
    python experiments/room.py --ablation       what each part is worth, and each error model
    python experiments/room.py --seeds 101 --draws 0 --cases "bearing known"      a part of it

A straight calibration drive in another room gives the sensor's errors, as in the paper; then every
room is driven round three times (60 m, an image every 20 cm), its lines are extracted and matched,
and the log is filtered and refined: positions with identities hidden, bearings with those of the
simulator and, once a room, bearings with identities hidden, with and without their looks.
Nothing is aligned unless it says so: the start pose is given, as the paper reads its errors off the
floor's tiles. Writes experiments/results/room.md and docs/room.png, points.png and lines.png; what
an earlier run measured and this one does not stays in the table.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from line_truth import CONTRAST, TALL, identified, named

from calibration import sensor_report
from calibration.points import apply_model, coverage, point_errors
from jaxslam import config_for, default_params, run
from jaxslam.logs.truth import truth_at
from jaxslam.results.metrics import association_accuracy, ate, pair_by_distance
from jaxslam.simulation.room.furniture import furnish
from jaxslam.simulation.room.geometry import visible_edges
from jaxslam.simulation.room.render import double_mirror_camera, nominal_camera, render_room
from jaxslam.vision.camera_files import load_camera
from jaxslam.vision.extract import extract
from jaxslam.vision.images import read_image
from jaxslam.vision.lines import LineSettings, extract_lines
from jaxslam.vision.log_triangulation import PointSettings
from jaxslam.vision.overlay import draw_lines, draw_on_image
from jaxslam.vision.panorama import panorama, unwrap

RESULTS = Path(__file__).parent / "results"
FIGURE = Path(__file__).parents[1] / "docs" / "room.png"
CALIBRATION = 100  # seed of the room of the straight drive
GATE = 0.15  # m, within which an edge counts as mapped
HIDDEN = "bearing hidden"
BLIND = HIDDEN + " without looks"
LIMIT, LIMIT_HIDDEN = 0.04, 0.05  # m, of the refined path and landmarks, RMSE
CASES = {  # sensor, association
    "position hidden": ("position", "maximum_likelihood"),
    "bearing known": ("bearing", "known"),
    HIDDEN: ("bearing", "maximum_likelihood"),
    BLIND: ("bearing", "maximum_likelihood"),
}
PROPOSAL = "prior"  # rooms 3 and 4: better than the informed one for positions, alike for bearings
MOTION = ("gain_tran", "gain_rot", "err_tran", "err_rot", "err_drift")
DRAWN = 101  # seed of the room in the figures
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
    """Errors of a run against truth and floor plan, filtered and (if it was) refined."""
    true = truth_at(log.truth, result.time)
    found = {
        "reckoning_m": ate(result.dead_reckoning, true, align=False)[0],
        "in_95": points_covered(log, seed),
        "frames": len(log.frame_time),
        "measurements": len(log.frame),
        "seconds": result.seconds,
    }
    found |= _of_stage("filtered", result.pose, result.landmarks, true, seed, log)
    if result.refined is not None:
        world = result.landmarks_refined
        found |= _of_stage("refined", result.refined.pose, world, true, seed, log)
        found["refine_seconds"] = result.refine_seconds
        found["association"] = association_accuracy(result, log, result.refined.landmark_id)
    return found


def _of_stage(stage, path, world, true, seed, log):
    """Of a path [T, 3] and a map; the aligned path apart, nothing is aligned.

    Landmarks are compared with the nearest edges, one to one, within `GATE`; those of known
    identity also with that edge, however far it is and however seldom it was seen.
    """
    wanted, every = edges_in_view(seed, log)
    pairs = pair_by_distance(world.mean, every, GATE)
    error = np.hypot(*(world.mean[pairs[:, 0]] - every[pairs[:, 1]]).T)
    known = (world.identity >= 0).any()
    off = np.hypot(*(world.mean - every[world.identity]).T) if known else error
    rms, most = ate(path, true, align=False)
    return {
        f"path_{stage}_m": rms,
        f"path_{stage}_max_m": most,
        f"path_{stage}_aligned_m": ate(path, true)[0],
        f"landmarks_{stage}_m": _rms(error),
        f"landmarks_{stage}_identified_m": _rms(off) if known else None,
        f"landmark_{stage}_median_m": float(np.median(off)) if len(off) else np.nan,
        f"landmark_{stage}_max_m": float(off.max()) if len(off) else np.nan,
        f"mapped_{stage}": len(pair_by_distance(world.mean, wanted, GATE)),
        f"spurious_{stage}": len(world.mean) - len(pairs),
        f"landmarks_{stage}": len(world.mean),
        "edges": len(wanted),
    }


def _rms(error):
    return float(np.sqrt(np.mean(error**2))) if len(error) else np.nan


def points_covered(log, seed):
    """Share of the triangulated points within their own 95 % ellipse about the true edge."""
    truth = replace(log.truth, landmarks=furnish(seed).edges.point, landmark_id=None)
    return coverage(point_errors(replace(log, truth=truth), log.noise["gain_tran"]))


COLUMNS = (
    ("path_filtered_m", "path filtered [m]", "{:.3f}"),
    ("path_refined_m", "path refined [m]", "{:.3f}"),
    ("path_refined_max_m", "most", "{:.3f}"),
    ("path_refined_aligned_m", "aligned", "{:.3f}"),
    ("landmarks_filtered_m", "landmarks filtered [m]", "{:.3f}"),
    ("landmarks_refined_m", "landmarks refined [m]", "{:.3f}"),
    ("landmarks_refined_identified_m", "by identity, all [m]", "{:.3f}"),
    ("landmark_refined_max_m", "most", "{:.2f}"),
    ("mapped_refined", "mapped", "{}"),
    ("edges", "of edges in view", "{}"),
    ("spurious_refined", "spurious", "{}"),
    ("association", "associations right", "{:.3f}"),
    ("in_95", "points in 95 %", "{:.3f}"),
    ("reckoning_m", "dead reckoning [m]", "{:.2f}"),
)


def table(rows):
    """Markdown of [(name, scores)]."""
    lines = ["| case | " + " | ".join(title for _, title, _ in COLUMNS) + " |"]
    lines.append("|---" * (len(COLUMNS) + 1) + "|")
    for name, found in rows:
        cells = [
            "" if found.get(key) is None else form.format(found[key]) for key, _, form in COLUMNS
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def limits(rows):
    """Markdown: the worst refined path and map of each case against its limit."""
    lines = ["| case | runs | refined path, worst [m] | refined landmarks, worst [m] | limit [m] "
             "| |", "|---" * 6 + "|"]  # fmt: skip
    cases = list(dict.fromkeys(name.split(",")[0] for name, _ in rows))
    for case in cases:
        some = [found for name, found in rows if name.split(",")[0] == case]
        # max() of arrays, unlike Python's, hands on a NaN, which holds no limit.
        path, world = (np.max([found[f"{what}_refined_m"] for found in some])
                       for what in ("path", "landmarks"))  # fmt: skip
        limit = LIMIT_HIDDEN if case.startswith(HIDDEN) else LIMIT
        state = "held" if path <= limit and world <= limit else "broken"
        lines.append(f"| {case} | {len(some)} | {path:.3f} | {world:.3f} | {limit} | {state} |")
    return "\n".join(lines)


def estimated(log, case, particles, seed, refine=True):
    """`Result` of one of `CASES`; what the log declares of the motion is what the paper's procedure
    found."""
    sensor, association = CASES[case]
    told = {} if association == "known" else {"landmarks": 192}
    told |= {} if case.startswith(HIDDEN) else {"proposal": PROPOSAL}
    told |= {"descriptors": 0} if case == BLIND else {}
    config = config_for(log, sensor, association, particles=particles, **told)
    return run(log, config, default_params(sensor, log), seed, refine=refine)


def draw(result, seed, path):
    """The paper's figs. 12, 13 and 14 side by side: plan with tiles, positions, map and paths."""
    import matplotlib
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    from jaxslam.plotting import STYLE, write_figure

    log = result.log
    true, refined = truth_at(log.truth, result.time), result.refined.pose
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
                axes.plot(*refined[:, :2].T, "o", ms=5, mfc="none", mec="#E69F00", mew=0.9)
            if i == 2:
                axes.plot(*true[:, :2].T, "-", color="#222222", lw=0.9)
                axes.plot(*refined[:, :2].T, ":", color="#0072B2", lw=1.4)
            if i:
                axes.plot(*result.refined.mean.T, "+", ms=8, mew=1.5, color="#D55E00")
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
    flat = nominal_camera(camera)
    blind = PointSettings(use_colour=False)
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
    lines = ["| room " + str(seed) + " | bearing, RMS | false lines a frame "
             "| path filtered [m] | path refined [m] | mapped | spurious |",
             "|---" * 7 + "|"]  # fmt: skip
    logs = {name: extracted(place, eye, found, **settings)
            for name, (eye, settings) in ablated(camera).items()}  # fmt: skip
    logs["one measurement per step"] = one_best(logs["all parts"])
    for name, log in logs.items():
        error, false = line_scores(log, seed)
        got = score(estimated(log, "position hidden", particles, seed), seed, log)
        cells = f"{error:.3f}° | {false:.2f} | {got['path_filtered_m']:.3f}"
        cells += f" | {got['path_refined_m']:.3f} | {got['mapped_refined']} of {got['edges']}"
        lines.append(f"| {name} | {cells} | {got['spurious_refined']} |")
        print(lines[-1], flush=True)
    return "\n".join(lines)


def models_in_the_filter(report, log, seed, particles):
    """Markdown: the candidates for a point's error, by held-out density and through the filter."""
    lines = ["| error model of a point | nats per held-out point | in 95 % | path filtered [m] "
             "| landmarks [m] | mapped | spurious |", "|---" * 7 + "|"]  # fmt: skip
    for model in report.models:
        result = estimated(
            apply_model(model, log), "position hidden", particles, seed, refine=False
        )
        got = score(result, seed, log)
        told = f"{model.held_out:.2f} | {100 * model.coverage:.0f} %"
        cells = f"{got['path_filtered_m']:.3f} | {got['landmarks_filtered_m']:.3f}"
        cells += f" | {got['mapped_filtered']} | {got['spurious_filtered']}"
        lines.append(f"| {model.name} | {told} | {cells} |")
        print(lines[-1], flush=True)
    return "\n".join(lines)


def record(name, found):
    """Write the row into the results, in place of what an earlier run has under that name."""
    print(table([(name, found)]).splitlines()[-1], flush=True)
    place = RESULTS / "room.json"
    every = json.loads(place.read_text()) if place.exists() else {}
    order = {case: i for i, case in enumerate(CASES)}
    rows = sorted((every | {name: found}).items(),
                  key=lambda row: (order[row[0].split(",")[0]], row[0]))  # fmt: skip
    place.write_text(json.dumps(dict(rows), indent=1) + "\n")
    (RESULTS / "room.md").write_text(limits(rows) + "\n\n" + table(rows) + "\n")


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--seeds", type=int, nargs="+", default=[101, 102, 103])
    options.add_argument("--draws", type=int, nargs="+", default=[0, 1, 2], help="filter's seeds")
    options.add_argument("--cases", nargs="+", default=list(CASES), choices=CASES)
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
    for seed in options.seeds:
        place = rendered(options.folder, seed, "loop", options.preset)
        log = extracted(place, load_camera(place / "camera.toml"), found)
        log = identified(log, furnish(seed))
        if seed == DRAWN:
            draw_lines_found(place, camera, FIGURE.with_name("lines.png"))
        for case in options.cases:
            for draws in options.draws[:1] if case.startswith(HIDDEN) else options.draws:
                result = estimated(log, case, options.particles, draws)
                record(f"{case}, room {seed}, run {draws}", score(result, seed, log))
                if (case, seed, draws) == ("position hidden", DRAWN, 0):
                    draw(result, seed, FIGURE)


if __name__ == "__main__":
    main()
