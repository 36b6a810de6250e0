"""Checks, Markdown tables and the figure of scaling.py's rows."""

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

UNKNOWN, KNOWN = "maximum_likelihood", "known"
NAMES = dict(
    jaxslam="jaxslam", numpy="NumPy", blocks="NumPy in blocks", numba="numba", c="plain C",
    loop="loop baseline",
)  # fmt: skip
WORD = {UNKNOWN: "unknown", KNOWN: "known"}
COLOURS = dict(
    jaxslam="tab:blue", numpy="tab:orange", blocks="tab:brown", numba="tab:green", c="tab:red",
    loop="0.5",
)  # fmt: skip
USUAL = dict(measurements=20, lazy=True, view=6, cores=1)


def found(rows, **wanted):
    """Rows with these settings (the usual ones where not said) that were measured."""
    wanted = USUAL | wanted
    return [r for r in rows if "min_ms" in r and all(r[k] == v for k, v in wanted.items())]


def least(rows, key="min_ms", **wanted):
    """The smallest time of such rows, or None."""
    return min((r[key] for r in found(rows, **wanted)), default=None)


def ratio(top, bottom):
    return None if top is None or bottom is None else top / bottom


def checks(rows):
    """(what, measured or None, limit, whether the limit is the most) of every target."""
    size = dict(particles=10_000, landmarks=100, association=UNKNOWN)
    ours = least(rows, who="jaxslam", **size)
    named = size | dict(landmarks=400, association=KNOWN)
    ours_named = least(rows, who="jaxslam", **named)
    targets = ("numpy", 30, False), ("blocks", 30, False), ("numba", 3, False), ("c", 1.5, True)
    for who, limit, most in targets:
        top, bottom = ours, least(rows, who=who, **size)
        what = f"time / {NAMES[who]}'s" if most else f"times faster than {NAMES[who]}"
        value = ratio(top, bottom) if most else ratio(bottom, top)
        yield f"unknown, N = 1e4, M = 100, K = 20: {what}", value, limit, most
    text = "known, N = 1e4, M = 400, K = 20: "
    for who in ("numpy", "blocks"):
        value = ratio(least(rows, who=who, **named), ours_named)
        yield f"{text}times faster than {NAMES[who]}", value, 8, False
    value = ratio(ours_named, least(rows, who="c", **named))
    yield f"{text}time / lazy plain C's", value, 2.5, True
    for association in (UNKNOWN, KNOWN):
        same = dict(who="jaxslam", particles=10_000, association=association)
        few, many = (least(rows, landmarks=m, **same) for m in (100, 1_600))
        text = f"{WORD[association]}: "
        yield text + "time at M = 1,600 / at M = 100, same in view", ratio(many, few), 1.3, True
        same = dict(who="jaxslam", landmarks=100, association=association)
        each = [least(rows, "ns", particles=n, **same) for n in (10_000, 100_000, 1_000_000)]
        spread = None if None in each else max(each) / min(each)
        text += "time per particle, most / least, N = 1e4 to 1e6"
        yield text, spread, 1.2, True
        peak = least(rows, "peak_of_state", particles=1_000_000, **same)
        text = f"{WORD[association]}: peak memory / State, 1e6 particles x 100 landmarks"
        yield text, peak, 1.3, True
        wall = [
            least(rows, "wall_min_ms", particles=200_000, devices=devices, **same | dict(cores=2))
            for devices in (1, 2)
        ]
        yield f"{WORD[association]}: two devices, times faster than one", ratio(*wall), 1.7, False


def check_lines(rows):
    for what, value, limit, most in checks(rows):
        if value is None:
            yield f"not measured: {what}: limit {'<=' if most else '>='} {limit}"
            continue
        held = value <= limit if most else value >= limit
        sign = "<=" if most else ">="
        yield f"{'held' if held else 'BROKEN'}: {what}: {value:.2f}, limit {sign} {limit}"


def number(value):
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def cell(rows, **wanted):
    """'min (median)' ms, or why not."""
    kept = found(rows, **wanted)
    if kept:
        best = min(kept, key=lambda r: r["min_ms"])
        return f"{number(best['min_ms'])} ({number(best['median_ms'])})"
    notes = [r.get("note") for r in rows if all(r[k] == v for k, v in (USUAL | wanted).items())]
    return short(notes[0]) if notes and notes[0] else ""


def short(note):
    return note.split(",")[0].replace("does not fit: needs", "refused:")


def table(rows):
    """ms of a step by contender and N (rows) and M (columns), K = 20, lazy, 6 m in view."""
    maps = sorted({r["landmarks"] for r in rows})
    yield "| identities | | particles | " + " | ".join(f"M = {m:,}" for m in maps) + " |"
    yield "|---|---|--:|" + "--:|" * len(maps)
    for association in (UNKNOWN, KNOWN):
        for who in NAMES:
            counts = {r["particles"] for r in rows if (r["who"], r["cores"]) == (who, 1)}
            for n in sorted(counts):
                same = dict(who=who, association=association, particles=n)
                cells = [cell(rows, landmarks=m, **same) for m in maps]
                if any(cells):
                    yield f"| {WORD[association]} | {NAMES[who]} | {n:,} | {' | '.join(cells)} |"


def others(rows):
    """Rows of jaxslam with one setting changed, with memory and bandwidth."""
    yield (
        "| identities | particles | M | K | resampling | in view | devices | ms |"
        " ns per particle × measurement | peak / State | must move, MB | of bandwidth |"
    )
    yield "|---|--:|--:|--:|---|--:|--:|--:|--:|--:|--:|--:|"
    for r in rows:
        if r["who"] != "jaxslam":
            continue
        usual = all(r[k] == v for k, v in USUAL.items())
        if usual and (r["particles"], r["landmarks"]) not in SHOWN:
            continue
        words = [WORD[r["association"]], f"{r['particles']:,}", f"{r['landmarks']:,}"]
        words += [str(r["measurements"]), "lazy" if r["lazy"] else "eager"]
        if "min_ms" not in r:
            words += ["", str(r["devices"]), short(r.get("note") or ""), "", "", "", ""]
        else:
            how = "wall_" if r["cores"] > 1 else ""
            wall = ", wall" if how else ""
            words += [f"{r['in_view']:.0f}", str(r["devices"])]
            words += [f"{number(r[how + 'min_ms'])} ({number(r[how + 'median_ms'])}){wall}"]
            large = r["state_bytes"] > LARGE
            words += [f"{r['ns']:.1f}", f"{r['peak_of_state']:.2f}" if large else ""]
            words += [number(r["moved_bytes"] / 1e6), f"{100 * r['of_bandwidth']:.0f} %"]
        yield f"| {' | '.join(words)} |"


SHOWN = {(10_000, m) for m in (25, 100, 400, 1_600)} | {(n, 100) for n in (1_000, 10**5, 10**6)}
LARGE = 3e8  # bytes of State beside which compiling takes little


def text(rows, machine):
    """Everything as Markdown."""
    rates = "; ".join(
        ", ".join(f"{kind} {rate:.1f}" for kind, rate in machine[when].items()) + f" {word}"
        for when, word in (("bandwidth", "before"), ("bandwidth_after", "after")) if when in machine
    )  # fmt: skip
    loads = [r["load"] for r in rows]
    apart = machine["numba"]
    numba = apart.get("note") or f"mean poses at most {apart['apart']:.1g} off NumPy's"
    skipped = sorted({f"{NAMES[r['who']]}: {r['note']}" for r in rows
                      if str(r.get("note")).startswith("skipped")})  # fmt: skip
    command = "python experiments/scaling.py" + (" --quick" if machine["quick"] else "")
    lines = [
        f"`{command}`: one core of {machine['cpu']}; CPU ms of a step, least (median);"
        f" {machine['seconds'] / 60:.0f} minutes, load average {min(loads):.1f} to"
        f" {max(loads):.1f}. K = 20, lazily resampled every step, 6 m in view.",
        "",
        *table(rows),
        "",
        "In blocks: 500 particles at once. The loop baseline has 4 particles. Plain C scores every"
        f" landmark, without clutter, existence or exclusion. numba: {numba}.",
        *(f"Skipped: {each}." for each in skipped),
        "",
        *others(rows),
        "",
        f"Bandwidth, GB/s read and written: {rates}; the share is of"
        f" {machine['best']:.1f}. What a step must move: `scaling.moved`. Peak"
        f" memory is beyond the {machine['idle_bytes'] / 1e6:.0f} MB of an idle process with JAX;"
        f" below {LARGE / 1e6:.0f} MB of State it is that of compiling, and left out.",
        "",
        *(f"- {each}" for each in check_lines(rows)),
    ]
    return "\n".join(lines) + "\n"


def curve(axis, rows, key, value, **wanted):
    """A line per contender and kind of identities."""
    for association, style in ((UNKNOWN, "-"), (KNOWN, "--")):
        for who, colour in COLOURS.items():
            given = wanted if who != "loop" else wanted | dict(particles=4)
            if who == "loop" and key == "particles":
                continue
            kept = found(rows, who=who, association=association, **given)
            points = {}
            for row in kept:
                if row.get(value):
                    points[row[key]] = min(row[value], points.get(row[key], float("inf")))
            if points:
                inside = colour if association == UNKNOWN else "white"
                axis.plot(*zip(*sorted(points.items()), strict=True), style, marker="o", ms=5,
                          mfc=inside, color=colour,
                          label=f"{NAMES[who]}, {WORD[association]}")  # fmt: skip


def draw(rows, path):
    """ns per particle × measurement against N and M, and peak memory against State."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    curve(left, rows, "particles", "ns", landmarks=100)
    left.set(xlabel="particles (M = 100, K = 20)", ylabel="ns per particle × measurement")
    curve(middle, rows, "landmarks", "ns", particles=10_000)
    middle.set(xlabel="landmarks of the map (N = 10,000, K = 20)")
    for lazy, marker in ((True, "o"), (False, "x")):
        kept = [r for r in rows if r["lazy"] == lazy and r.get("peak_of_state")]
        kept = [r for r in kept if r["devices"] == 1]
        if not kept:
            continue
        label = "lazy" if lazy else "eager"
        right.plot([r["state_bytes"] for r in kept], [r["peak_bytes"] for r in kept], marker,
                   color="tab:blue", ms=5, mfc="none", label=f"jaxslam, {label}")  # fmt: skip
    ends = [r["state_bytes"] for r in rows if r.get("state_bytes")]
    ends = [min(ends), max(ends)]
    right.plot(ends, ends, color="0.6", label="State")
    right.plot(ends, [1.3 * e for e in ends], ":", color="0.4", label="1.3 × State")
    right.set(xlabel="bytes of State", ylabel="peak bytes beyond an idle process")
    for axis in (left, middle, right):
        axis.set(xscale="log", yscale="log")
        axis.grid(alpha=0.3)
    right.legend(fontsize=8, loc="lower right")
    handles = {}
    for axis in (left, middle):
        handles |= dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=5, fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)
