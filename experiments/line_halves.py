"""Whether the two halves of vertical lines agree: a test of a camera's tilt and calibration."""

import numpy as np

from jaxslam.vision import lines
from jaxslam.vision.edge_localisation import fit_segments
from jaxslam.vision.edges import PAD

LEAST_HALF = 6  # rows of half a line


def halves(image, camera, settings=None):
    """Bearings [n] rad of the upper and of the lower halves of lines at least twice `length` long.

    They differ if the camera's tilt or calibration is wrong.
    """
    settings = settings or lines.LineSettings()
    view, picture = lines._panorama(image, camera, settings)
    edges, level = lines._edges(picture, view, settings)
    wide = lines._columns_per_pixel(view)
    fit = fit_segments(edges, wide)
    keep = lines._upright(fit, view, settings, level)
    keep &= (fit.last - fit.first) * view.row_height >= 2 * settings.length
    lower = edges.row > ((fit.first + fit.last) / 2)[edges.segment]
    count = [np.bincount(edges.segment, part, len(keep)) for part in (~lower, lower)]
    keep &= np.minimum(*count) >= LEAST_HALF
    kept = keep[edges.segment]
    segment = np.unique(2 * edges.segment[kept] + lower[kept], return_inverse=True)[1]
    part = edges._replace(segment=segment, row=edges.row[kept], column=edges.column[kept])
    column = fit_segments(part, wide)
    upper, lower = view.bearing(column.column.reshape(-1, 2) - PAD).T
    both = np.isfinite(upper) & np.isfinite(lower)
    return upper[both], lower[both]
