"""How near to each other may lines stand? Association and errors against their spacing.

    python experiments/spacing.py                    all cells, one after another
    python experiments/spacing.py --filters joint    one filter only
    python experiments/spacing.py --report           table and figure of the cells that are there
    python experiments/spacing.py --quick            a little of everything, in runs/spacing

Bearings alone, identities hidden, in simulated rooms (`spacing_world`) whose 24 lines are 0.1, 0.3
or 1 m apart, with 1 and 3 degrees of bearing noise, 40 m of driving; ours beside an EKF that
associates by nearest neighbour and by joint compatibility (`spacing_rivals`), and both filters
with known identities, to tell what the hiding costs. All are given the noise that was drawn.

A finished cell is a line of OUT/spacing.jsonl: a run that was interrupted goes on where it was.
After changes of a filter, `--again` with `--filters` measures its cells again.
Writes experiments/results/spacing.md and docs/spacing.png.
"""

import argparse
import json
import os
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import spacing_rivals as rivals
import spacing_world as world
from scipy.optimize import linear_sum_assignment

import jaxslam
from jaxslam.results import metrics

HERE = Path(__file__).parent
RESULTS, FIGURE = HERE / "results", HERE.parent / "docs" / "spacing.png"
QUICK = Path("runs/spacing")
FILTERS = {  # name: (what it is called, colour, line)
    "nearest": ("EKF, nearest neighbour", "tab:orange", "-"),
    "joint": ("EKF, joint compatibility", "tab:green", "-"),
    "ekf known": ("EKF, identities known", "tab:green", ":"),
    "jaxslam": ("jaxslam, refined", "tab:blue", "-"),
    "jaxslam known": ("jaxslam, refined, identities known", "tab:blue", ":"),
}
CUT_OFF = 0.5  # m, what a line that was not found, or one that is not there, counts
PANELS = (
    ("right", "bearings put to the right line [share]"),
    ("path_m", "path, RMS error [m]"),
    ("ospa_m", f"map, OSPA to {CUT_OFF} m [m]"),
)


def estimate(name, log, params, particles, seed):
    """{stage: (pose [T, 3], row [T, K], match [T, K], map [L, 2], identity [L])} of a run, the
    stage to be judged first, and what else is to be kept."""
    if not name.startswith("jaxslam"):
        rule = "known" if name == "ekf known" else name
        found = rivals.run(log, params, rule)
        stage = found.pose, found.row, found.landmark_id, found.mean, found.identity
        return {"filtered": stage}, {"cut": found.cut}
    settings = dict(particles=particles, measurements=world.MOST)
    if name == "jaxslam known":
        settings |= dict(association="known", proposal="informed", landmarks=world.LINES)
    config = jaxslam.config_for(log, sensor="bearing", **settings)
    result = jaxslam.run(log, config, params, seed)
    marks, stages = result.landmarks, {}
    if result.refined is not None:
        again = result.landmarks_refined
        path = result.refined.pose, result.row, result.refined.landmark_id
        stages["refined"] = (*path, again.mean, again.identity)
    stages["filtered"] = (result.pose, result.row, result.landmark_id, marks.mean, marks.identity)
    # with known identities clutter is left out by design
    return stages, {"flags": [flag for flag in result.flags if not flag.endswith(": no identity")]}


def measures(log, pose, row, match, mean, identity):
    """What is told of one estimate: shares of all measurements, and errors in m (SE(2)-aligned).

    `right`: `evaluate.association_accuracy`, which asks whose measurement began the landmark.
    `one_to_one`: `shared`. `wrong`: put to a landmark that another line began, or clutter put to
    any. `aside`: of a line, but put to nothing. `begun`: the rest, which began a landmark though
    there was one, or is clutter. `matched`, `missed`, `spurious` and `landmark_m` pair within half
    the spacing (`evaluate.map_error`), so that they differ with it; `ospa_m` does not (`ospa`).
    """
    truth = log.truth
    who = np.where(row >= 0, truth.identity[row.clip(0)], -1).ravel()
    taken, counted = match.ravel(), match.ravel() >= -2
    wrong = (taken >= 0) & ((who[taken.clip(0)] != who) | (who < 0))
    true = metrics.truth_at(truth, log.frame_time)
    motion = metrics.align_se2(pose[:, :2], true[:, :2])
    found = metrics.map_error(mean, identity, truth, motion)
    given = SimpleNamespace(log=log, row=row, landmark_id=match)
    label = np.where(taken == -1, np.arange(taken.size), taken)
    told = dict(
        right=metrics.association_accuracy(given, log),
        one_to_one=shared(who[counted], label[counted]),
        wrong=float(wrong[counted].mean()),
        aside=float(((taken == -2) & (who >= 0))[counted].mean()),
        path_m=metrics.ate(pose, true)[0],
        ospa_m=ospa(metrics.apply_se2(motion, mean), truth.landmarks),
        landmark_m=found.get("rmse_m"),
    )
    told["begun"] = 1 - told["right"] - told["wrong"] - told["aside"]
    return told | {key: found[key] for key in ("matched", "missed", "spurious")}


def shared(who, label):
    """The share of the lines' measurements that are in their line's own landmark, if every line may
    call one landmark its own: one that is held twice, or hijacked early, counts by what it became.

    `who` [n]: true lines, -1 clutter. `label` [n]: landmarks, below 0: none.
    """
    of_line = who >= 0
    some = of_line & (label >= 0)
    if not some.any():
        return 0.0
    lines, line = np.unique(who[some], return_inverse=True)
    marks, mark = np.unique(label[some], return_inverse=True)
    count = np.zeros((len(lines), len(marks)))
    np.add.at(count, (line, mark), 1)
    return float(count[linear_sum_assignment(-count)].sum() / of_line.sum())


def ospa(mean, landmarks):
    """Distance [m] of a map [L, 2] from the true lines [M, 2], misses and false ones included:
    order 2, cut off at `CUT_OFF` (Schuhmacher, Vo and Vo, "A consistent metric for performance
    evaluation of multi-object filters", IEEE T-SP 56(8), 2008)."""
    gap = np.hypot(*(np.reshape(mean, (-1, 1, 2)) - landmarks).transpose(2, 0, 1))
    cost = np.minimum(gap, CUT_OFF) ** 2
    least, most = sorted(cost.shape)
    total = cost[linear_sum_assignment(cost)].sum() + CUT_OFF**2 * (most - least)
    return float(np.sqrt(total / most))


def cell(name, spacing, degrees, seed, particles, length):
    """One line of the file: which cell it is, and the `measures` of it."""
    log = world.room(seed, spacing, degrees, length)
    params = jaxslam.default_params("bearing", log)
    begin = time.perf_counter()
    stages, more = estimate(name, log, params, particles, seed)
    seconds = time.perf_counter() - begin
    told = {stage: measures(log, *given) for stage, given in stages.items()}
    which = dict(zip(KEY, (name, spacing, degrees, seed, particles, length), strict=True))
    return which | {"seconds": seconds, "stages": told} | more


KEY = ("filter", "spacing", "degrees", "seed", "particles", "length")


def key(row):
    return tuple(row[name] for name in KEY)


def read(file):
    """Rows by key; what a killed run left half written is not one."""
    found = {}
    for line in file.read_text().splitlines() if file.exists() else ():
        try:
            row = json.loads(line)
        except ValueError:
            continue
        found[key(row)] = row
    return found


def write(file, rows):
    """All rows, in place of what was there; never half of them."""
    file.parent.mkdir(parents=True, exist_ok=True)
    new = file.with_suffix(".new")
    new.write_text("".join(json.dumps(row) + "\n" for row in rows.values()))
    os.replace(new, file)


def fill(file, cells, again=False):
    """Measure the cells (keys) that are not in the file, or all of them `again`."""
    rows = read(file)
    todo = [which for which in cells if again or which not in rows]
    for i, which in enumerate(todo):
        rows[which] = row = cell(*which)
        write(file, rows)
        first = next(iter(row["stages"].values()))
        name, spacing, degrees, seed, *_ = which
        print(
            f"{i + 1} of {len(todo)}: {name}, {spacing:g} m, {degrees:g}°, seed {seed}: "
            f"right {first['right']:.2f}, path {first['path_m']:.3f} m, {row['seconds']:.1f} s",
            flush=True,
        )


def chosen(rows, name, spacing, degrees, stage=None):
    """`measures` of a filter's seeds in one room; `stage` None: the one to be judged."""
    some = [
        r for r in rows if (r["filter"], r["spacing"], r["degrees"]) == (name, spacing, degrees)
    ]
    stages = [r["stages"] for r in some]
    return [each[stage or next(iter(each))] for each in stages if not stage or stage in each]


def values(told, key):
    return np.array([np.nan if one.get(key) is None else one[key] for one in told], float)


def spread(found, digits=3):
    found = found[np.isfinite(found)]
    if not len(found):
        return ""
    text = f"{np.median(found):.{digits}f}"
    if len(found) == 1:
        return text
    return text + f" ({found.min():.{digits}f}-{found.max():.{digits}f})"


def table_row(label, degrees, spacing, told, seconds):
    shares = " | ".join(f"{values(told, k).mean():.2f}" for k in SHARES)
    errors = " | ".join(spread(values(told, k)) for k in ("path_m", "ospa_m", "landmark_m"))
    counts = " / ".join(f"{values(told, k).mean():.3g}" for k in ("matched", "missed", "spurious"))
    return (
        f"| {degrees:g}° | {spacing:g} m | {label} | {len(told)} | {shares} | {errors} | {counts}"
        f" | {seconds:.3g} |"
    )


SHARES = ("right", "one_to_one", "wrong", "aside", "begun")


def text(rows):
    """The table: a line per noise, spacing and filter; ours also before refinement."""
    lines = [
        "`python experiments/spacing.py`: shares of bearings, mean over seeds; errors in m,"
        " RMS, after SE(2) alignment, median (least-most) over seeds.",
        "",
        "| noise | apart | filter | seeds | right | one to one | wrong | aside | begun in vain"
        " | path | map, OSPA | landmarks | matched / missed / spurious | s |",
        "|--:|--:|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for degrees in sorted({row["degrees"] for row in rows}):
        for spacing in sorted({row["spacing"] for row in rows}):
            for name, (label, *_) in FILTERS.items():
                of = [r for r in rows if key(r)[:3] == (name, spacing, degrees)]
                if not of:
                    continue
                seconds = np.median([row["seconds"] for row in of])
                told = chosen(rows, name, spacing, degrees)
                lines.append(table_row(label, degrees, spacing, told, seconds))
                before = chosen(rows, name, spacing, degrees, "filtered")
                if name.startswith("jaxslam") and before != told:
                    label = label.replace("refined", "filter alone")
                    lines.append(table_row(label, degrees, spacing, before, seconds))
    cut = sum(row.get("cut", 0) for row in rows)
    lines += ["", f"Searches of joint compatibility cut off at {rivals.NODES:,} nodes: {cut}."]
    flags = [
        f"- {name}, {spacing:g} m, {degrees:g}°, seed {seed}: {flag}"
        for (name, spacing, degrees, seed, *_), row in ((key(row), row) for row in rows)
        for flag in row.get("flags", ())
    ]
    return (
        "\n".join([*lines, *(["", "Flags of runs:", "", *sorted(flags)] if flags else [])]) + "\n"
    )


def draw(rows, path):
    """A row of panels per bearing noise; dots are seeds, lines their medians."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    noises = sorted({row["degrees"] for row in rows})
    size = 12, 0.6 + 3.2 * len(noises)
    figure, axes = plt.subplots(
        len(noises), 3, figsize=size, layout="constrained", squeeze=False, sharex=True
    )
    for axis_row, degrees in zip(axes, noises, strict=True):
        for axis, (what, label) in zip(axis_row, PANELS, strict=True):
            _panel(axis, rows, degrees, what)
            axis.set(ylabel=label, title=f"{degrees:g}° of bearing noise")
    for axis in axes[-1]:
        axis.set_xlabel("lines apart [m]")
    handles, names = axes[0, 1].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _panel(axis, rows, degrees, what):
    from matplotlib.ticker import LogLocator

    spacings = sorted({row["spacing"] for row in rows})
    for i, (name, (label, colour, line)) in enumerate(FILTERS.items()):
        if what == "right" and "known" in name:
            continue  # right by definition
        at, middle = [], []
        for spacing in spacings:
            found = values(chosen(rows, name, spacing, degrees), what)
            found = found[np.isfinite(found)]
            if len(found):
                beside = spacing * 1.04 ** (i - 2)  # so that dots do not cover one another
                axis.plot([beside] * len(found), found, ".", color=colour, alpha=0.5)
                at, middle = [*at, beside], [*middle, np.median(found)]
        if at:
            axis.plot(at, middle, line, color=colour, label=label, marker="o", markersize=3)
    axis.set_xscale("log")
    axis.set_xticks(spacings, [f"{spacing:g}" for spacing in spacings])
    axis.minorticks_off()
    if what == "right":
        axis.set_ylim(0, 1)
    else:
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.yaxis.set_minor_formatter("")
    axis.grid(alpha=0.3)


def arguments(argv):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--filters", nargs="+", default=list(FILTERS), choices=FILTERS)
    parser.add_argument("--spacings", nargs="+", type=float, default=list(world.SPACINGS))
    parser.add_argument("--degrees", nargs="+", type=float, default=list(world.DEGREES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--particles", type=int, default=1000, help="ours")
    parser.add_argument("--length", type=float, default=40.0, help="m to drive")
    parser.add_argument("--again", action="store_true", help="cells that are there, too")
    parser.add_argument("--report", action="store_true", help="of the cells that are there")
    parser.add_argument("--quick", action="store_true", help="6 m, seed 0, 50 particles")
    parser.add_argument("--out", type=Path, help="folder of table and cells")
    parser.add_argument("--figure", type=Path, help="where the figure goes")
    given = parser.parse_args(argv)
    if given.quick:
        given.length, given.seeds, given.particles = 6.0, [0], 50
    given.out = given.out or (QUICK if given.quick else RESULTS)
    usual = FIGURE if given.out == RESULTS else given.out / FIGURE.name
    given.figure = given.figure or usual
    return given


def main(argv=None):
    given = arguments(argv)
    file = given.out / "spacing.jsonl"
    if not given.report:
        fill(file, [
            (name, float(spacing), float(degrees), seed, given.particles, given.length)
            for name in given.filters for degrees in given.degrees
            for spacing in given.spacings for seed in given.seeds
        ], given.again)  # fmt: skip
    sizes = given.particles, given.length
    rows = [row for row in read(file).values() if key(row)[4:] == sizes]
    if not rows:
        raise SystemExit(f"spacing: no cells of {sizes[0]} particles and {sizes[1]:g} m in {file}")
    (given.out / "spacing.md").write_text(text(rows))
    draw(rows, given.figure)
    print(text(rows))


if __name__ == "__main__":
    main()
