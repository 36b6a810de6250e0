"""A run's errors as a table for people."""

from math import pi

PATHS = {  # label, and the beginning of its keys, the end of the first, the beginning of the last
    "path, filter": ("ate_filtered", "rmse_m", "filtered"),
    "path, ancestral": ("ate_ancestral", "rmse_m", "ancestral"),
    "path, refined": ("ate_refined", "rmse_m", "refined"),
    "path, dead reckoning": ("dead_reckoning_ate", "m", "dead_reckoning"),
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


def error_table(summary):
    """The errors of a summary as text for people: what was estimated beside dead reckoning."""
    text = []
    if "ate_filtered_unaligned_rmse_m" in summary:
        text.append(_row(("", "aligned RMSE", "unaligned RMSE", "unaligned max", "at the end")))
        for label, (name, rmse, end) in PATHS.items():
            if f"{name}_unaligned_rmse_m" in summary:
                keys = [f"{name}_{key}" for key in (rmse, "unaligned_rmse_m", "unaligned_max_m")]
                told = [_metres(summary, key) for key in (*keys, f"{end}_end_m")]
                text.append(_row((label, *told)))
    for label, name, counts in (
        ("landmarks, filter", "landmark_filtered", "landmarks"),
        ("landmarks, refined", "landmark_refined", "landmarks_refined"),
    ):
        text += _map_lines(summary, label, name, counts)
    for key, label, scale, unit in NUMBERS:
        if key in summary:
            value = summary[key] * scale
            number = f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
            text.append(f"{label:24}{number}{unit}")
    return "\n".join(text) if text else "The log has no truth to compare with."


def _map_lines(summary, label, name, counts):
    """Lines about one map: its errors, and what of the true one was found."""
    if f"{counts}_unaligned_matched" not in summary:
        return []
    keys = f"{name}_rmse_m", f"{name}_unaligned_rmse_m"
    text = [_row((label, *(_metres(summary, key) for key in keys)))]
    for kind, place in ((counts, "aligned: "), (f"{counts}_unaligned", "unaligned: ")):
        if f"{kind}_matched" in summary:
            told = [f"{summary[f'{kind}_{k}']} {k}" for k in ("matched", "missed", "spurious")]
            text.append(f"{place:>24}{', '.join(told)}")
    gate = summary.get("landmark_gate_m")
    text[-1] += f" (gate {gate:.2f} m)" if gate is not None else " (paired by identity)"
    return text


def _row(cells):
    return f"{cells[0]:24}" + "".join(f"{cell:>16}" for cell in cells[1:])


def _metres(summary, key):
    return f"{summary[key]:.3f} m" if key in summary else "-"
