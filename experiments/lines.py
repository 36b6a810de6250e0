"""Lines and matches on rendered images against the room (the tables of docs/results/images.md).

    python experiments/lines.py     (about 5 minutes) writes experiments/results/lines.md

Rooms 111-114 were not looked at while the extraction was made. For every preset: the error of a
line's bearing to the edge it is paired with (one to one, within 1 degree), false lines (no visible
edge within 0.5 degrees), recall of landmarks with contrast of at least 0.08 and 10 degrees in view,
and the time to unwrap and extract on one core; then matches between frames 10 and 20 cm apart,
while light and white balance change. Of lines within 0.2 degrees of an edge: precision is the share
of their matches that are again so near to the same edge, recall that of those whose edge has such a
line in both frames.
"""

import time
from pathlib import Path

import cv2
import numpy as np
from line_truth import named

from jaxslam.logs.truth import wrap
from jaxslam.simulation.room.furniture import furnish
from jaxslam.simulation.room.render import PRESETS, double_mirror_camera, render_frames
from jaxslam.simulation.room.trajectory import stop_and_go
from jaxslam.vision.lines import extract_lines
from jaxslam.vision.matching import match

RESULTS = Path(__file__).parent / "results"
SEEDS = (111, 112, 113, 114)
SAME = np.radians(0.2)  # a line is an edge's if so near to where the edge is to be seen
EVERY = 12  # every so many stops of the drive a frame is looked at


def lines_row(preset):
    """One preset over all rooms."""
    camera, errors, ratio, seconds = double_mirror_camera(), [], [], []
    false = found = wanted = count = 0
    for seed in SEEDS:
        world, drive = furnish(seed), stop_and_go("loop", seed, length=20.0)
        drive = drive._replace(pose=drive.pose[::EVERY], command=drive.command[::EVERY])
        for image, pose, _ in render_frames(world, camera, drive, PRESETS[preset], seed):
            begin = time.process_time()
            lines = extract_lines(image, camera)
            seconds.append(time.process_time() - begin)
            identity, error, bad, clear = named(lines.bearing, world, pose)
            errors.append(error)
            ratio.append(error / lines.sigma)
            false, count = false + bad.sum(), count + 1
            found, wanted = found + np.isin(clear, identity).sum(), wanted + len(clear)
    errors, ratio = (np.concatenate(part) for part in (errors, ratio))
    errors, ratio = errors[np.isfinite(errors)], ratio[np.isfinite(ratio)]
    rms, robust = np.sqrt(np.mean(errors**2)), 1.4826 * np.median(np.abs(errors))
    cells = [f"{np.degrees(rms):.3f}°", f"{np.degrees(robust):.3f}°", f"{false / count:.2f}"]
    cells += [f"{found / wanted:.3f}", f"{np.sqrt(np.mean(ratio**2)):.2f}"]
    cells += [f"{1e3 * np.median(seconds[3:]):.1f} ms", f"{count}"]
    return f"| {preset} | " + " | ".join(cells) + " |"


def match_row(step, colour):
    """Precision and recall of matches between neighbouring frames of `normal` light."""
    camera = double_mirror_camera()
    right = made = possible = met = 0
    for seed in SEEDS:
        world, drive = furnish(seed), stop_and_go("loop", seed, step=step, length=5.0)
        before = None
        for image, pose, command in render_frames(world, camera, drive, PRESETS["normal"], seed):
            lines = extract_lines(image, camera)
            identity, error, _, _ = named(lines.bearing, world, pose)
            identity = np.where(np.abs(error) < SAME, identity, -1)  # surely that edge
            if before is not None:
                pairs = match(before[0], lines, (command[0], 0.0, command[1]), colour)
                pairs = pairs[before[1][pairs[:, 0]] >= 0]
                to = world.edges.point[before[1][pairs[:, 0]]] - pose[:2]
                there = np.arctan2(to[:, 1], to[:, 0]) - pose[2]
                good = np.abs(wrap(lines.bearing[pairs[:, 1]] - there)) < SAME
                right, made = right + good.sum(), made + len(pairs)
                both = np.flatnonzero((before[1] >= 0) & np.isin(before[1], identity))
                met += np.isin(both, pairs[good, 0]).sum()
                possible += len(both)
            before = lines, identity
    cells = f"{right / made:.3f} | {met / possible:.3f} | {made}"
    return f"| {100 * step:.0f} cm | {'with' if colour else 'without'} | {cells} |"


def main():
    cv2.setNumThreads(1)
    text = ["| images | bearing, RMS | robust SD | false lines a frame | recall | RMS of error / σ "
            "| time | frames |", "|---" * 8 + "|"]  # fmt: skip
    for preset in PRESETS:
        text.append(lines_row(preset))
        print(text[-1], flush=True)
    text += ["", "| step | colour | precision | recall | matches |", "|---" * 5 + "|"]
    for step in (0.1, 0.2):
        for colour in (True, False):
            text.append(match_row(step, colour))
            print(text[-1], flush=True)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "lines.md").write_text("\n".join(text) + "\n")


if __name__ == "__main__":
    main()
