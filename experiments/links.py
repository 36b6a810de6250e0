"""How well can a bearing be followed from one image to the next? What hidden identities rest on.

    python experiments/links.py

Of every log with measured identities: how far apart two landmarks of one image lie, how far a
landmark's next bearing (within a second) is from where the odometry puts it, and how often the
nearest such prediction is that of the right landmark; the landmark's distance is not used, nothing
is estimated. Also by which offset of the images' stamps the odometry fits best, and what is gained.
Then, where landmarks stand less than half a metre apart, how many are found of a refined map that
was told the identities, if it is judged as one that was not: paired with the true ones by place,
within half the least distance between two of these. MRCLAM may not be redistributed: left out where
absent. Writes experiments/results/links.md. Two minutes.
"""

import dataclasses
from pathlib import Path

import batch
import jax
import numpy as np
import worlds

from jaxslam import config_for, default_params, load_log, run
from jaxslam.filter.frames import frames_from_log
from jaxslam.logs.clock_offset import shift_frames
from jaxslam.logs.truth import wrap
from jaxslam.models.motion import model
from jaxslam.results.metrics import compute_errors, landmark_gate

RESULTS = Path(__file__).parent / "results"
WITHIN = 1.0  # s between two looks at a landmark
NEAR = 0.25  # m: a gate below it is asked what it would let through
TURNING = np.radians(3)  # between them
OFFSETS = np.arange(-10, 11) * 0.05  # s


def logs():
    """(name, log, params) of every log."""
    woods = load_log("lost-in-the-woods")
    yield "Lost in the Woods", woods, default_params("bearing", woods)
    room = worlds.room(7)
    yield "room 7", room, default_params("bearing", room)
    for robot in range(1, 6):
        log, file = batch.mrclam(robot)
        if log is not None:
            yield f"MRCLAM D6 robot {robot}", log, batch.gained(log, file, "bearing")


def followed(log, params):
    """Of every bearing whose landmark was seen just before: how far it is from where the odometry
    put it [rad], the turn since [rad], and whether nothing else seen just before is nearer."""
    data = frames_from_log(log, config_for(log, "bearing"), params)
    who = np.append(log.identity, -1)[data.row]
    heading = np.cumsum(model(jax.tree.map(np.asarray, data.odometry), params).turn)
    time, bearing = data.time / 1e9, data.measurements.value[..., 0]
    last, found = {}, []
    for t, names in enumerate(who):
        fresh = {name: at for name, at in last.items() if time[t] - time[at[0]] < WITHIN}
        there = {name: wrap(b - heading[t] + heading[at]) for name, (at, b) in fresh.items()}
        for name, b in zip(names, bearing[t], strict=True):
            if name < 0:
                continue
            last[name] = t, b
            if name in there:
                off = {other: abs(wrap(b - place)) for other, place in there.items()}
                turn = heading[t] - heading[fresh[name][0]]
                found.append((off[name], abs(turn), off[name] <= min(off.values())))
    return np.array(found).T


def apart(log):
    """Angles between neighbouring bearings of an image [rad]."""
    order = np.lexsort((log.bearing, log.frame))
    gaps = np.diff(log.bearing[order])
    return gaps[np.diff(log.frame[order]) == 0]


def best_offset(log, params):
    """The offset [s] of the images' stamps with which odometry puts bearings nearest (90 %)."""

    def error(offset):
        return np.quantile(followed(shift_frames(log, offset), params)[0], 0.9)

    return float(min(OFFSETS, key=error))


def by_place(log, params):
    """Landmarks found and all, of a map that was told the identities, paired by place."""
    result = run(log, config_for(log, "bearing", association="known"), params)
    hidden = result.refined._replace(identity=np.full(len(result.refined.identity), -1))
    found = compute_errors(dataclasses.replace(result, refined=hidden))
    return f"{found['landmarks_refined_matched']} of {len(log.truth.landmarks)}"


def degrees(values, shares=(0.5, 0.9)):
    return " / ".join(f"{np.degrees(np.quantile(values, share)):.2f}" for share in shares)


def row(name, log, params):
    gaps, offset = apart(log), best_offset(log, params)
    cells = [name, f"{np.diff(log.view[:2])[0] * 180 / np.pi:.0f}", degrees(gaps, (0.1, 0.5))]
    for at in (0.0, offset):
        off, turn, right = followed(shift_frames(log, at), params)
        turning = turn > TURNING
        cells += [f"{at:+.2f}", degrees(off[~turning]), degrees(off[turning])]
        cells += [f"{100 * right.mean():.1f}", f"{100 * right[turning].mean():.1f}"]
    gate = landmark_gate(log.truth.landmarks)
    cells += [f"{2 * gate:.2f}", by_place(log, params) if gate < NEAR else ""]
    return "| " + " | ".join(cells) + " |"


def main():
    head = ["log", "view [deg]", "apart in one image [deg], 10 % / median"]
    for _ in ("as stamped", "by the best offset"):
        head += ["images moved [s]", "off, straight [deg], median / 90 %", "off, turning"]
        head += ["nearest is right [%]", "turning"]
    head += ["least distance of two landmarks [m]", "found by place, told identities"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for given in logs():
        lines.append(row(*given))
        print(lines[-1], flush=True)
    (RESULTS / "links.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
