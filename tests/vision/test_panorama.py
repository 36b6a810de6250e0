"""Panorama, perspective and bird's-eye views: every pixel shows what lies in its direction."""

from dataclasses import replace
from math import pi

import cv2
import numpy as np
import pytest
from stripes import mirror_camera, painted, photograph

from jaxslam.vision.panorama import birds_eye, directions, panorama, perspective, unwrap


def smooth(direction):
    x, y, z = np.moveaxis(direction, -1, 0)
    return 127 + 100 * np.stack([x, y, z], -1)


@pytest.mark.parametrize("change", ({}, {"yaw": 1.0}, {"roll": 0.03, "pitch": -0.02}))
def test_the_panorama_shows_what_lies_in_each_direction(change):
    camera = mirror_camera(**change)
    view = panorama(camera)
    seen = unwrap(photograph(painted(camera, smooth)), view)
    expected = smooth(directions(view.azimuth[None], view.elevation[:, None]))
    inner = view.valid & (cv2.erode(view.valid.astype(np.uint8), np.ones((5, 5))) > 0)
    assert inner.mean() > 0.9
    assert np.abs(seen - expected)[inner].max() < 3


def test_left_is_left_and_columns_are_bearings():
    view = panorama(mirror_camera(), columns=720)
    assert (np.diff(view.azimuth) < 0).all()
    assert abs(view.azimuth[359] + view.azimuth[360]) < 1e-12  # ahead is in the middle
    assert np.allclose(np.diff(view.elevation), view.elevation[1] - view.elevation[0])
    column = np.array([-3.2, -0.5, 0.0, 12.3, 719.4])
    bearing = view.bearing(column)
    assert ((bearing > -pi) & (bearing <= pi)).all()
    assert np.allclose(view.column(bearing), (column + 0.5) % 720 - 0.5)
    assert np.allclose(view.bearing(np.arange(720)), view.azimuth)
    assert np.allclose(view.row(view.elevation), np.arange(len(view.elevation)))


def test_rows_follow_the_images_resolution_and_the_extent_what_is_seen():
    camera = mirror_camera()
    view = panorama(camera)
    low, high = camera.elevation
    radius = np.hypot(*(camera.project(directions(0.0, np.array([low, high]))) - (322.3, 238.1)).T)
    assert abs(len(view.elevation) - (radius[0] - radius[1])) < 3
    assert low < view.elevation[-1] < view.elevation[0] < high
    wide = panorama(replace(camera, elevation=(-pi / 2, pi / 2)))
    assert wide.elevation[-1] > -1.2  # what lies below the image is left out
    assert wide.valid.any(axis=1).all()


def test_nothing_beyond_the_cameras_elevations_is_shown():
    camera = replace(mirror_camera(), elevation=(0.1, 0.8))
    view = panorama(camera, elevation=(0.0, 1.0))
    outside = (view.elevation < 0.1) | (view.elevation > 0.8)
    assert not view.valid[outside].any() and view.valid[~outside].all()
    assert not unwrap(np.full((480, 640, 3), 255, np.uint8), view)[outside].any()


def test_views_are_cached_and_cannot_be_changed():
    camera = mirror_camera()
    view = panorama(camera)
    assert panorama(camera) is view
    assert panorama(camera, columns=720) is not view
    assert not any(array.flags.writeable for array in view)


def test_a_view_of_nothing_is_refused():
    camera = mirror_camera()
    with pytest.raises(ValueError, match=r"sees nothing at elevations of -90\.0 to -68\.8 deg"):
        panorama(camera, elevation=(-pi / 2, -1.2))
    with pytest.raises(ValueError, match="columns"):
        panorama(camera, columns=3)
    with pytest.raises(ValueError, match="must rise"):
        panorama(camera, elevation=(0.5, 0.2))


def test_straight_lines_are_straight_in_perspective():
    camera = mirror_camera(yaw=0.4, roll=0.01)
    view = perspective(camera, azimuth=0.7, elevation=0.5, field=1.0, width=320, height=240)
    assert view.valid.all()
    focal = 160 / np.tan(0.5)
    # a pixel's direction, from the definition of the pinhole camera
    for u, v in ((159.5, 119.5), (300.0, 40.0), (10.0, 220.0)):
        across, down = -(u - 159.5) / focal, (v - 119.5) / focal
        ahead = np.array([np.cos(0.5), 0, np.sin(0.5)])
        up = np.array([-np.sin(0.5), 0, np.cos(0.5)])
        x, y, z = ahead + across * np.array([0, 1, 0]) - down * up
        c, s = np.cos(0.7), np.sin(0.7)
        expected = camera.project(np.array([c * x - s * y, s * x + c * y, z]))
        i, j = int(np.floor(v)), int(np.floor(u))
        corners = [
            (i, j),
            (i, j + (u % 1 > 0)),
            (i + (v % 1 > 0), j),
            (i + (v % 1 > 0), j + (u % 1 > 0)),
        ]
        found = np.mean([(view.map_x[c], view.map_y[c]) for c in corners], axis=0)
        assert np.abs(found - expected).max() < 0.05
    with pytest.raises(ValueError, match="field"):
        perspective(camera, field=pi)


def test_the_floor_from_above_has_square_tiles():
    camera = mirror_camera(elevation=(-1.0, 1.1), position=(0.1, 0.0, 0.6))

    def tiles(direction):
        reach = 0.6 / np.maximum(-direction[..., 2:], 1e-9)
        xy = direction[..., :2] * reach + np.array([0.1, 0.0])
        return np.repeat(127 + 100 * np.cos(2 * pi * xy).prod(-1, keepdims=True), 3, -1)

    view = birds_eye(camera, extent=4.0, size=256)
    seen = unwrap(photograph(painted(camera, tiles)), view)
    metres = 4.0 * (1 - (2 * np.arange(256) + 1) / 256)
    x, y = np.meshgrid(metres, metres, indexing="ij")  # ahead is up, left is left
    expected = 127 + 100 * np.cos(2 * pi * x) * np.cos(2 * pi * y)
    near = view.valid & (np.hypot(x - 0.1, y) < 2.0) & (np.hypot(x - 0.1, y) > 1.2)
    assert near.sum() > 1000
    assert np.abs(seen[..., 0] - expected)[near].mean() < 12
    assert not view.valid[np.hypot(x - 0.1, y) < 0.3].any()  # under the camera nothing is seen
    with pytest.raises(ValueError, match=r"0 m above the floor"):
        birds_eye(replace(camera, position=(0.0, 0.0, 0.0)))
