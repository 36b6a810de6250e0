"""Lines on recorded mirror images: drawn on the panorama, and whether a line's halves agree.

    python experiments/real_lines.py ../shared/data runs/real-lines

The images may not be redistributed, but for one; without them there is nothing to do. Tilt is found
from the lines themselves first. Writes a panorama with its lines for every image into the folder
named last, and experiments/results/real-lines.md.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from line_halves import halves

from calibration.tilt import camera_with_tilt, find_tilt
from jaxslam.vision.camera_files import load_camera
from jaxslam.vision.images import read_image
from jaxslam.vision.lines import extract_lines
from jaxslam.vision.overlay import draw_lines
from jaxslam.vision.panorama import panorama, unwrap

RESULTS = Path(__file__).parent / "results"


def cases(data):
    """Name -> (camera, images): OCamCalib's own set, and an office by the author of a package."""
    folder = data / "calib_ocam_vmr"
    camera = load_camera(folder / "calib_results_catadioptric.txt", mirror=True)
    names = [f"VMRImage{i}.jpg" for i in range(10)]  # the first is the set's test image, too
    yield "OCamCalib", replace(camera, elevation=(-0.6, 0.35)), [folder / name for name in names]
    folder = data / "omni_single_pyomniunwarp"
    camera = load_camera(folder / "calib_results.txt", mirror=True)
    yield "office", replace(camera, elevation=(-0.3, 0.6)), [folder / "example.jpg"]


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("data", type=Path)
    options.add_argument("out", type=Path)
    options = options.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    text = ["| images | lines | pitch, roll found | halves, median difference | before the tilt |",
            "|---|--:|--:|--:|--:|"]  # fmt: skip
    for name, camera, paths in cases(options.data):
        images = [(path.name, read_image(path)) for path in paths]
        # The office's calibration is of the picture without 300 columns left and 320 right.
        images = [(n, i if i.shape[1] == camera.width else i[:, 300:-320]) for n, i in images]
        found = find_tilt(images, camera)
        level = camera_with_tilt(camera, found)
        before, after, count = [], [], 0
        for file, image in images:
            for eye, differences in ((camera, before), (level, after)):
                upper, lower = halves(image, eye)
                differences.append(np.abs(upper - lower))
            lines, view = extract_lines(image, level), panorama(level)
            count += len(lines.bearing)
            picture = draw_lines(unwrap(image, view), lines, view)
            cv2.imwrite(str(options.out / f"{name}-{Path(file).stem}.png"), picture)
        angles = f"{np.degrees(found.pitch):+.2f}°, {np.degrees(found.roll):+.2f}°"
        medians = [np.degrees(np.median(np.concatenate(part))) for part in (after, before)]
        cells = f"{count} | {angles} | {medians[0]:.3f}° | {medians[1]:.3f}°"
        text.append(f"| {name}, {len(images)} | {cells} |")
        print(text[-1], flush=True)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "real-lines.md").write_text("\n".join(text) + "\n")


if __name__ == "__main__":
    main()
