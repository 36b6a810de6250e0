"""Camera calibration on real and simulated boards: `python experiments/camera.py` (5 minutes).

Real sets: residuals of every corner, those on boards left out (two-fold, every second image), and
times. Simulated: the rendered room's camera, 25 boards, 0.1 px of noise; the error of the bearing
map over its stated standard deviation. The images are recorded data that may not be redistributed:
sets that are absent are left out. Writes experiments/results/camera.md.
`--quick`: one set, five simulations, nothing written.
"""

import argparse
import pickle
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from simulated_boards import azimuth_error, simulate_boards

from calibration.camera import calibrate_camera, calibrate_corners, cross_validate
from jaxslam.simulation.room.render import double_mirror_camera

RESULTS = Path(__file__).parent / "results"
DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SETS = (
    ("OCamCalib's mirror", "calib_ocam_vmr/VMR*.jpg", (6, 7), 0.03, True),
    ("Fisheye2", "calib_fisheye2", (6, 8), 0.117, False),
    ("parabolic mirror", "calib_inria_para", (8, 6), 0.042, True),
)
GIVEN = ("ov_plane (corners given)", "calib_babelcalib/ov_plane", (1280, 800))
COLD = """
import pickle, sys
from calibration.camera import calibrate_corners
calibrate_corners(**pickle.load(open(sys.argv[1], "rb")))
"""


def real_rows(quick):
    rows = []
    for name, images, board, square, mirror in SETS[: 1 if quick else None]:
        if not (DATA / images).parent.is_dir():
            continue
        given = dict(board=board, square=square, mirror=mirror)
        for model, simple in (("polynomial", False), ("polynomial", True), ("unified", False)):
            begin = time.process_time()
            found = calibrate_camera(DATA / images, **given, model=model, simple=simple)
            rows.append(row(name, model, found, time.process_time() - begin, simple))
    if (DATA / GIVEN[1]).is_dir() and not quick:
        pixels, points = read_orpc(DATA / GIVEN[1])
        for model in ("polynomial", "unified"):
            begin = time.process_time()
            found = calibrate_corners(pixels, points, GIVEN[2], model=model)
            rows.append(row(GIVEN[0], model, found, time.process_time() - begin))
    return rows


def row(name, model, found, seconds, simple=False):
    key = found.order or model
    left = cross_validate(found.corners, {key: found.solution}, model, found.order, simple)[key]
    label = f"{model} {found.order or ''}".strip() + ", no decentring" * simple
    counts = f"{len(found.names)} of {len(found.names) + len(found.rejected)}"
    corners = f"{len(left)} ({found.again} / {len(found.outliers)})"
    return (
        f"| {name} | {label} | {found.variant} | {counts}"
        f" | {corners} | {found.mean:.4f} / {found.rms:.4f}"
        f" | {left.mean():.4f} / {np.sqrt(np.mean(left**2)):.4f}"
        f" | {found.bearings.rms_deg:.3f} / {found.bearings.max_deg:.3f} | {seconds:.1f} |"
    )


def read_orpc(folder):
    """Corners (lists of [n, 2]) of BabelCalib's files: rows of (board, corner, 1, u, v)."""
    text = (folder / "ov_plane.dsc").read_text().splitlines()[2:]
    known = np.array([line.split(",")[3:5] for line in text], float)
    pixels, points = [], []
    for file in sorted((folder / "train").glob("*.orpc")):
        lines = [line.split(",") for line in file.read_text().splitlines() if line.count(",") == 4]
        pixels.append(np.array([line[3:] for line in lines], float))
        points.append(known[[int(line[1]) for line in lines]])
    return pixels, points


def cold_seconds():
    """Wall and CPU time of a fresh process, imports and compilation included, corners given: the
    quickest of three; a simulated set of OCamCalib's size."""
    camera, times = double_mirror_camera(), []
    pixels, points = simulate_boards(camera, 10, 0.2)
    with tempfile.NamedTemporaryFile() as file:
        file.write(pickle.dumps(dict(pixels=pixels, points=points, size=camera.size)))
        file.flush()
        for _ in range(3):
            begin = time.perf_counter(), children_seconds()
            subprocess.run([sys.executable, "-c", COLD, file.name], check=True)
            times.append((time.perf_counter() - begin[0], children_seconds() - begin[1]))
    return min(times)


def children_seconds():
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def simulations(count):
    """Azimuth RMS errors [n] deg, RMS of error over stated sigma [n], orders chosen [n]."""
    true, errors, ratios, orders = double_mirror_camera(), [], [], []
    for seed in range(count):
        pixels, points = simulate_boards(true, 25, 0.1, seed)
        found = calibrate_corners(pixels, points, true.size)
        error, sigma = azimuth_error(found.camera, true, found.coverage.radius)
        errors.append(np.degrees(np.sqrt(np.mean(error**2))))
        ratios.append(np.sqrt(np.mean((error / sigma) ** 2)))
        orders.append(found.order)
    return np.array(errors), np.array(ratios), orders


def report(rows, cold, errors, ratios, orders):
    chosen = ", ".join(f"{order}: {orders.count(order)}" for order in sorted(set(orders)))
    lines = [
        f"Camera calibration; jax {jax.__version__}, numpy {np.__version__}. Every corner counts in"
        " mean and RMS. Left out: two-fold over images, poses of the left-out boards estimated.",
        "",
        "| set | model | corners by | images | corners (found again / left aside)"
        " | mean / RMS [px] | on boards left out | azimuth σ, RMS / most [°] | CPU s |",
        "|---|---|---|--:|--:|--:|--:|--:|--:|",
        *rows,
        "",
        f"One calibration in a fresh process, corners given, imports included: {cold[0]:.1f} s, of"
        f" CPU {cold[1]:.1f} s.",
        "",
        f"{len(errors)} simulated calibrations (640 × 480 double mirror, 25 boards, 0.1 px):"
        f" azimuth error of the mapping {np.sqrt(np.mean(errors**2)):.4f}° RMS (median"
        f" {np.median(errors):.4f}°, worst {errors.max():.4f}°); over its stated σ"
        f" {np.sqrt(np.mean(ratios**2)):.2f} RMS; orders chosen {chosen}.",
    ]
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one set, five simulations")
    given = parser.parse_args()
    cold = cold_seconds()
    print(text := report(real_rows(given.quick), cold, *simulations(5 if given.quick else 50)))
    if not given.quick:
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / "camera.md").write_text(text)


if __name__ == "__main__":
    main()
