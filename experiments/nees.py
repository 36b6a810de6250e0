"""Are the uncertainties honest? `python experiments/nees.py` (one core; minutes: see the result).

Simulated worlds, drawn from the filter's own model: driven blindly (`closed_loop=False`), since
commands that answer to the noise tell of it, which a filter does not use. The start is known,
nothing is aligned, and the filter has the simulation's parameters.

Filter: pose NEES (3 degrees of freedom, the filter's own covariance) over 100 worlds a case, the
same for both proposals. ANEES / 3 should be 1; its 99.9 % band is that of chi-square.
Bearings leave the band by step 100. It is the filter, not the worlds: the last pose of least
squares over the same 100 steps has 1.02. Of the coarse case's worst worlds, with the informed
proposal, one was honest with more particles (NEES / 3 of 10.5 with 2,000, 1.6 with 10,000; least
squares 0.3): the early paths on which the map hangs had died out. Two were not (3.5 and 4.9 with
10,000; least squares 1.3 and 0.9): more than depletion is at work. A wider prior of inverse depth
was no cure. Longer drives are over-confident: the filter's rows beside refinement's.
Refinement: how many true poses and landmarks are inside the 95 % ellipses of the refined path and
map after 500 steps, and of the filter's. Poses count at every step, as (x, y, heading) and as
positions; a hidden landmark is the one that most of its measurements are of.
Writes experiments/results/nees.json and .md, case by case (`--only`: replaces those).
"""

import argparse
import json
import os
import time
from pathlib import Path

os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2

from jaxslam.config import Config
from jaxslam.filter import map_estimate
from jaxslam.filter import step as fastslam
from jaxslam.filter.frames import frames_from_log
from jaxslam.logs.truth import wrap
from jaxslam.parameters import Params, default_params
from jaxslam.simulation.planar import planar
from jaxslam.smoother.genealogy import Tree, trace_lineage
from jaxslam.smoother.refine import refine

RESULTS = Path(__file__).parent / "results"
SLOTS, MOST = 48, 8  # landmarks in the map, measurements in a frame
AT = (10, 30, 100)
LONG = 500  # steps after which refinement is judged
INSIDE = 0.95


def degrees(*values):
    return tuple(float(np.deg2rad(v)) for v in values)


def case(name, world, noise, view, sensor="range_bearing", association="known", **other):
    """`noise`: m and degrees. `view`: bearing limits in degrees, range in m. `other`: changes."""
    settings = dict(steps=AT[-1], runs=100, particles=2000, declared_density=False)
    settings |= dict(closed_loop=False, proposals=("prior", "informed"))
    return settings | other | dict(
        name=name, world=world, sensor=sensor, association=association,
        noise=(noise[0], *degrees(noise[1])), view=(*degrees(*view[:2]), view[2]),
    )  # fmt: skip


ROUND, SIDE = (-180, 180), (-150, -30)
HIDDEN = dict(association="maximum_likelihood")
FILTERED = (
    case("coarse bearing; known", "room", (0.2, 8), (*ROUND, 5.0), "bearing"),
    case("bearing; known", "room", (0.2, 4), (*ROUND, 5.0), "bearing", particles=3000),
    case("range, bearing; known", "grid", (0.2, 4), (*ROUND, 5.0)),
    case("range, bearing; hidden", "grid", (0.2, 3), (*ROUND, 4.0), **HIDDEN),
    case("position; known", "grid", (0.2, 4), (*ROUND, 5.0), "position"),
    case("limits: precise sensor; known", "field", (0.1, 2), (*ROUND, 8.0), particles=1000),
    case("limits: new landmarks at the declared density; hidden", "grid", (0.2, 3), (*ROUND, 4.0),
         declared_density=True, proposals=("informed",), **HIDDEN),
)  # fmt: skip
AFTER = dict(steps=LONG, particles=1000, proposals=("informed",))
REFINED = (
    case("refined, bearing; known", "room", (0.2, 4), (*ROUND, 5.0), "bearing", **AFTER),
    case("refined, range, bearing; hidden", "grid", (0.2, 3), (*ROUND, 4.0), runs=30,
         **AFTER, **HIDDEN),
)  # fmt: skip


def simulated(given, seed):
    """The case's log of one seed, its frames, and the filter's parameters."""
    log = planar(
        given["world"], seed, length_m=0.1 * (given["steps"] + 0.5), landmarks=40,
        sigma_range=given["noise"][0], sigma_bearing=given["noise"][1], view=given["view"],
        max_per_frame=MOST, closed_loop=given["closed_loop"],
    )  # fmt: skip
    params = default_params(given["sensor"], log)._replace(correlation=0.0, extra_bearing_noise=0.0)
    if not given["declared_density"]:
        params = params._replace(density_new=default_params().density_new)
    return (
        log,
        frames_from_log(log, config_of(given, "prior"), params),
        params,
    )


def kept(info):
    return info.estimate, info.resampled, info.new


def kept_with_past(info):
    return *kept(info), info.pose, info.landmark_id, info.ancestors


def filtered(log, data, params, config, seed, keep):
    """The state at the end and what was kept of every step; the origin is the start's place."""
    key, origin = jax.random.key(seed), np.array([*log.start_pose[:2], 0.0])
    state = fastslam.init(config, key, log.start_pose - origin, log.start_cov)
    odometry, measurements = jax.tree.map(jnp.asarray, (data.odometry, data.measurements))
    numbers = jax.tree.map(jnp.asarray, Params(*map(float, params)))
    state, trace = fastslam.run(key, state, odometry, measurements, numbers, config, keep)
    return state, jax.tree.map(np.asarray, trace), origin


def squares(error, cov):
    """NEES [n] of errors [n, d] with covariances [n, d, d]."""
    # A micrometre more: all particles may have become one.
    cov = np.asarray(cov, float) + 1e-12 * np.eye(error.shape[1])
    return np.sum(error * np.linalg.solve(cov, error[..., None])[..., 0], 1)


def pose_squares(pose, cov, log):
    """NEES [T] of poses, and of their positions alone."""
    error = pose - log.truth.pose
    error[:, 2] = wrap(error[:, 2])
    return squares(error, cov), squares(error[:, :2], cov[:, :2, :2])


def one_filtered(given, config, seed):
    """NEES [T] of one world; how often it resampled, and landmarks begun per true one seen."""
    log, data, params = simulated(given, seed)
    _, (estimate, resampled, new), origin = filtered(log, data, params, config, seed, kept)
    seen = len(np.unique(log.truth.identity[log.truth.identity >= 0]))
    whole, _ = pose_squares(estimate.mean + origin, estimate.cov, log)
    return whole, resampled.mean(), new.sum() / seen


def config_of(given, proposal):
    return Config(
        sensor=given["sensor"], association=given["association"], proposal=proposal,
        particles=given["particles"], landmarks=SLOTS, measurements=MOST,
    )  # fmt: skip


def measure(given, proposal):
    """A filter row: ANEES / 3 at the steps `AT`, with the least and greatest allowed."""
    config, runs, begin = config_of(given, proposal), given["runs"], time.perf_counter()
    found = [one_filtered(given, config, seed) for seed in range(runs)]
    nees, resampled, born = zip(*found, strict=True)
    nees = np.array(nees) / 3
    band = chi2.ppf([0.0005, 0.9995], 3 * runs) / (3 * runs)
    return given | dict(
        proposal=proposal, band=band.tolist(), resampled=float(np.mean(resampled)),
        anees_over_3={t: float(nees[:, t - 1].mean()) for t in AT},
        median_over_its_own={
            t: float(np.median(nees[:, t - 1]) * 3 / chi2.ppf(0.5, 3)) for t in AT
        },
        greatest_of_one_world={t: float(nees[:, t - 1].max()) for t in AT},
        landmarks_per_true=float(np.mean(born)), seconds=time.perf_counter() - begin,
    )  # fmt: skip


def truth_of(match, data, log, ids, count):
    """The true landmark [L] that most measurements of each label are of; -1: clutter."""
    place = np.arange(match.size).reshape(match.shape)
    label = np.where(match == -1, place, match)
    who = np.where(data.row >= 0, log.truth.identity[data.row], -1)
    best = []
    for each in ids:
        votes = np.bincount(who[label == each] + 1, minlength=count + 1)
        best.append(votes.argmax() - 1)
    return np.array(best, int)


def map_squares(mean, cov, match, ids, data, log):
    """NEES [L] of the landmarks of a map that are of a true one; how many true ones it lacks."""
    marks = log.truth.landmarks
    of = truth_of(match, data, log, ids, len(marks))
    real = of >= 0
    xx, xy, yy = np.asarray(cov, float)[real].T
    full = np.stack([xx, xy, xy, yy], 1).reshape(-1, 2, 2)
    seen = np.unique(log.truth.identity[data.row[data.row >= 0]])
    missed = np.setdiff1d(seen[seen >= 0], of)
    return squares(mean[real] - marks[of[real]], full), len(missed), int(np.sum(~real))


def one_refined(given, config, seed):
    """NEES of poses, positions and landmarks, by estimate, of one world; and seconds."""
    begin = time.perf_counter()
    log, data, params = simulated(given, seed)
    state, trace, origin = filtered(log, data, params, config, seed, kept_with_past)
    estimate, _, _, pose, landmark_id, ancestors = trace
    tree = Tree()
    tree.extend(pose, landmark_id, ancestors)
    best = int(np.argmax(ancestors[-1] == estimate.best[-1]))
    past = trace_lineage(tree, best)
    middle = time.perf_counter()
    found = refine(
        data, past.pose + origin, past.landmark_id, log.start_pose, log.start_cov, params,
        given["sensor"], config.association == "known",
    )  # fmt: skip
    end = time.perf_counter()
    numbers = jax.tree.map(jnp.asarray, Params(*map(float, params)))
    table = map_estimate.summarise(
        fastslam.settle(state, config).landmarks, jnp.exp(state.log_weight), best, numbers, config
    )
    table = jax.tree.map(np.asarray, table)
    keep = np.flatnonzero(table.kept)
    mean, cov = table.mean[:, keep].T + origin[:2], table.cov[:, keep].T
    marks, *lost = map_squares(mean, cov, past.landmark_id, table.landmark_id[keep], data, log)
    filter_ = *pose_squares(estimate.mean + origin, estimate.cov, log), marks, *lost
    marks, *lost = map_squares(
        found.mean, found.landmark_cov, found.landmark_id, found.id, data, log
    )
    refined_ = *pose_squares(found.pose, found.cov, log), marks, *lost
    return filter_, refined_, (middle - begin, end - middle), found.converged


def shares(found):
    """Of every world's NEES of poses, positions, landmarks: shares inside, with their standard
    errors over the worlds; ANEES over dimensions at the end; landmarks missed and of nothing."""
    row = {}
    for i, (name, size) in enumerate((("poses", 3), ("positions", 2), ("landmarks", 2))):
        inside = [np.mean(world[i] < chi2.ppf(INSIDE, size)) for world in found]
        error = np.std(inside, ddof=1) / np.sqrt(len(inside)) if len(inside) > 1 else np.nan
        row[name] = float(np.mean(inside)), float(error)
    row["anees_over_3"] = float(np.mean([world[0][-1] for world in found]) / 3)
    row["landmark_anees_over_2"] = float(np.mean(np.concatenate([w[2] for w in found])) / 2)
    row["missed"], row["of_nothing"] = (float(np.mean([w[i] for w in found])) for i in (3, 4))
    return row


def measure_refined(given, proposal):
    """A refinement row."""
    config, begin = config_of(given, proposal), time.perf_counter()
    found = [one_refined(given, config, seed) for seed in range(given["runs"])]
    filter_, refined_, seconds, converged = zip(*found, strict=True)
    return given | dict(
        proposal=proposal, filter=shares(filter_), refined=shares(refined_),
        median_seconds=np.median(seconds, 0).tolist(), converged=float(np.mean(converged)),
        seconds=time.perf_counter() - begin,
    )  # fmt: skip


def setting(row):
    (range_, bearing), reach = row["noise"], row["view"][2]
    noise = f"{np.rad2deg(bearing):.0f}°"
    noise = noise if row["sensor"] == "bearing" else f"{range_} m, {noise}"
    return f"{row['world']}, {noise}, {reach:.0f} m | {row['particles']} | {row['proposal']}"


FILTER_HEAD = (
    "| sensor; identities | world, noise, sight | particles | proposal | "
    + " | ".join(f"step {t}" for t in AT)
    + " | worst world | steps resampled | landmarks begun per true one |\n|---|---|--:|---|"
    + "--:|" * (len(AT) + 3)
)


def filter_line(row):
    low, high = row["band"]
    cells = [
        f"{value:.3g} {'in' if low <= value <= high else '**out**'}"
        for value in row["anees_over_3"].values()
    ]
    return (
        f"| {row['name']} | {setting(row)} | {' | '.join(cells)}"
        f" | {max(row['greatest_of_one_world'].values()):.1f} | {row['resampled']:.0%}"
        f" | {row['landmarks_per_true']:.2f} |"
    )


REFINED_HEAD = (
    "| sensor; identities | world, noise, sight | particles | proposal | runs | estimate | poses"
    " | positions | landmarks | ANEES / 3 at the end | of landmarks, / 2 | landmarks missed"
    " | of nothing |\n|---|---|--:|---|--:|---|" + "--:|" * 7
)


def refined_lines(row):
    for name in ("filter", "refined"):
        one = row[name]
        cells = [
            f"{share:.1%} ± {error:.1%}"
            for share, error in (one[kind] for kind in ("poses", "positions", "landmarks"))
        ]
        yield (
            f"| {row['name']} | {setting(row)} | {row['runs']} | {name} | {' | '.join(cells)}"
            f" | {one['anees_over_3']:.3g} | {one['landmark_anees_over_2']:.3g}"
            f" | {one['missed']:.2f} | {one['of_nothing']:.2f} |"
        )


def tables(rows):
    """Both tables as text, of the rows there are."""
    filters = [row for row in rows if "band" in row]
    refined = [row for row in rows if "band" not in row]
    lines = ["Filter: ANEES / 3 of the pose", "", FILTER_HEAD, *map(filter_line, filters), ""]
    if filters:
        runs, (low, high) = filters[0]["runs"], filters[0]["band"]
        lines[0] += f", {runs} runs, 99.9 % band [{low:.3f}, {high:.3f}]."
    lines += [f"Truth inside the {INSIDE:.0%} ellipses in {LONG} steps (± standard error):", ""]
    lines += [REFINED_HEAD, *(line for row in refined for line in refined_lines(row)), ""]
    minutes = sum(row["seconds"] for row in rows) / 60
    return "\n".join([*lines, f"{minutes:.0f} minutes, on a core that others used too."]) + "\n"


def write(rows):
    """Results with these rows among those that were there, in the cases' order."""
    path = RESULTS / "nees.json"
    order = [(each["name"], p) for each in FILTERED + REFINED for p in each["proposals"]]
    found = {
        key: row
        for row in (json.loads(path.read_text()) if path.exists() else []) + rows
        if (key := (row["name"], row.get("proposal"))) in order
    }
    ordered = json.loads(json.dumps([found[key] for key in order if key in found]))
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "nees.md").write_text(tables(ordered))
    path.write_text(json.dumps(ordered, indent=1) + "\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, help="instead of each case's own; nothing is written")
    parser.add_argument("--particles", type=int, help="the same")
    parser.add_argument("--only", default="", help="cases whose names begin so")
    given = parser.parse_args()
    changes = {k: getattr(given, k) for k in ("particles", "runs") if getattr(given, k)}
    for each in FILTERED + REFINED:
        for proposal in each["proposals"] if each["name"].startswith(given.only) else ():
            long = each["steps"] == LONG
            row = (measure_refined if long else measure)(each | changes, proposal)
            for text in refined_lines(row) if long else [filter_line(row)]:
                print(text, flush=True)
            print(f"{row['seconds']:.0f} s", flush=True)
            if not changes:
                write([row])


if __name__ == "__main__":
    main()
