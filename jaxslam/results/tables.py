"""Tables of numbers as text: one formatter of columns, and the errors of a run."""

from math import pi

PATHS = {  # label; parts of the keys: how they begin, RMSE with alignment, error at the end
    "path, filter": ("ate_filtered", "rmse_m", "filtered"),
    "path, ancestral": ("ate_ancestral", "rmse_m", "ancestral"),
    "path, refined": ("ate_refined", "rmse_m", "refined"),
    "path, dead reckoning": ("dead_reckoning_ate", "m", "dead_reckoning"),
}
MAPS = {  # label; how the keys of errors and of counts begin
    "landmarks, filter": ("landmark_filtered", "landmarks"),
    "landmarks, refined": ("landmark_refined", "landmarks_refined"),
}
NUMBERS = (
    ("heading_filtered_rmse_rad", "heading, filter", 180 / pi, "° RMSE, unaligned"),
    ("heading_refined_rmse_rad", "heading, refined", 180 / pi, "° RMSE, unaligned"),
    ("rpe_1m_m", "per metre, filter", 1, " m"),
    ("refined_rpe_1m_m", "per metre, refined", 1, " m"),
    ("dead_reckoning_rpe_1m_m", "per metre, reckoning", 1, " m"),
    ("association_accuracy", "association, filter", 100, " % right"),
    ("association_accuracy_refined", "association, refined", 100, " % right"),
    ("nees_median", "pose NEES, median", 1, " (2.37 if the filter knew its error)"),
    ("nees_within_99", "within its 99 % region", 100, " % of frames"),
    ("nees_refined_median", "refined NEES, median", 1, " (2.37 if it knew its error)"),
    ("nees_refined_within_99", "within its 99 % region", 100, " % of frames"),
    ("truth_resolution_m", "truth read to", 1, " m"),
)


def format_table(rows, align):
    """Format rows of texts as lines, in columns aligned by `align`: `<` or `>` for each."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(f"{text:{a}{w}}" for text, a, w in zip(row, align, widths, strict=True)).rstrip()
        for row in rows
    )


def error_table(summary):
    """Format the errors in a `summary` (`summary.json` as a dict) as text for people."""
    lines = []
    if "ate_filtered_unaligned_rmse_m" in summary:
        heads = "aligned RMSE", "unaligned RMSE", "unaligned max", "at the end"
        lines.append(_row("", heads))
        for label, (name, rmse, end) in PATHS.items():
            if f"{name}_unaligned_rmse_m" in summary:
                keys = [f"{name}_{key}" for key in (rmse, "unaligned_rmse_m", "unaligned_max_m")]
                lines.append(_error_row(label, summary, (*keys, f"{end}_end_m")))
    for label, (name, counts) in MAPS.items():
        lines += _map_lines(summary, label, name, counts)
    for key, label, scale, unit in NUMBERS:
        if key in summary:
            value = summary[key] * scale
            number = f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
            lines.append(f"{label:24}{number}{unit}")
    return "\n".join(lines) if lines else "The log has no truth to compare with."


def _map_lines(summary, label, name, counts):
    """Return lines about one map: its errors, and how many true landmarks it has."""
    if f"{counts}_unaligned_matched" not in summary:
        return []
    lines = [_error_row(label, summary, (f"{name}_rmse_m", f"{name}_unaligned_rmse_m"))]
    for kind, title in ((counts, "aligned: "), (f"{counts}_unaligned", "unaligned: ")):
        if f"{kind}_matched" in summary:
            numbers = [f"{summary[f'{kind}_{k}']} {k}" for k in ("matched", "missed", "spurious")]
            lines.append(f"{title:>24}{', '.join(numbers)}")
    gate = summary.get("landmark_gate_m")
    lines[-1] += f" (gate {gate:.2f} m)" if gate is not None else " (paired by identity)"
    return lines


def _row(label, cells):
    return f"{label:24}" + "".join(f"{cell:>16}" for cell in cells)


def _error_row(label, summary, keys):
    return _row(label, [f"{summary[key]:.3f} m" if key in summary else "-" for key in keys])
