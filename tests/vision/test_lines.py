"""Vertical lines: where they are, how sure of it, and what must not become one."""

from dataclasses import replace
from math import pi
from types import SimpleNamespace

import numpy as np
import pytest
from line_halves import halves
from scipy.optimize import linear_sum_assignment
from stripes import mirror_camera, painted, photograph, room_of_stripes, stripes

from jaxslam.simulation.room.furniture import furnish
from jaxslam.simulation.room.geometry import visible_edges
from jaxslam.simulation.room.render import PRESETS, double_mirror_camera, render_frames
from jaxslam.vision.line_merging import merge_pieces, separate_close_pairs
from jaxslam.vision.lines import Lines, LineSettings, extract_lines, is_dark
from jaxslam.vision.overlay import draw_lines, draw_on_image
from jaxslam.vision.panorama import panorama, unwrap

CAMERA = mirror_camera()
GREY, WHITE = (90.0,) * 3, (190.0,) * 3


def turned(angle):
    return (np.asarray(angle) + pi) % (2 * pi) - pi


def paired(azimuth, lines, gate=0.0175):
    """Indices of edges, of their lines, and the errors [rad]."""
    away = turned(lines.bearing - azimuth[:, None])
    i, j = linear_sum_assignment(np.minimum(np.abs(away), gate))
    near = np.abs(away[i, j]) < gate
    return i[near], j[near], away[i, j][near]


def bands(azimuth, **changes):
    """Lines of a world that is white between pairs of azimuths [rad], else grey; and the image."""
    azimuth = np.radians(np.atleast_1d(azimuth))
    colour = np.where(np.arange(len(azimuth))[:, None] % 2, GREY, WHITE)
    options = {"noise": changes.pop("noise", 2.0), "blur": changes.pop("blur", 0.5)}
    camera = changes.pop("camera", CAMERA)
    image = photograph(stripes(camera, azimuth, colour, back=GREY, **changes), **options)
    return extract_lines(image, camera), image


@pytest.mark.parametrize(
    ("noise", "blur", "most"), ((0.0, 0.0, 0.03), (4.0, 0.7, 0.04), (8.0, 1.1, 0.1))
)
def test_bearings_are_found_and_their_deviations_are_true(noise, blur, most):
    errors, ratios, found, false = [], [], 0, 0
    for seed in range(4):
        azimuth, image = room_of_stripes(CAMERA, seed, 30, noise, blur)
        lines = extract_lines(image, CAMERA)
        _, j, away = paired(azimuth, lines)
        errors.extend(np.degrees(away))
        ratios.extend(away / lines.sigma[j])
        found, false = found + len(j), false + len(lines.bearing) - len(j)
    assert np.sqrt(np.mean(np.square(errors))) < most
    assert abs(np.mean(errors)) < 0.01
    assert found >= 0.9 * 120
    assert false <= 1
    assert 0.15 < np.sqrt(np.mean(np.square(ratios))) < 1.3


def test_lines_are_sorted_and_carry_ends_polarity_and_colours():
    azimuth = np.radians([-100.0, -20.0, 40.0, 130.0])
    colour = [(30, 60, 200), (180, 60, 40), (60, 200, 60), (90, 90, 90)]
    image = photograph(stripes(CAMERA, azimuth, colour, low=0.1, high=0.6), noise=1.0)
    lines = extract_lines(image, CAMERA)
    assert len(lines.bearing) == 4
    assert (np.diff(lines.bearing) > 0).all()
    assert np.abs(lines.bearing - azimuth).max() < np.radians(0.05)
    assert np.abs(lines.low - 0.1).max() < 0.03 and np.abs(lines.high - 0.6).max() < 0.03
    # left is the greater azimuth: the stripe that begins at the edge
    left, right = np.array(colour) / 255, np.roll(colour, 1, axis=0) / 255
    assert np.abs(lines.colour[:, 0] - left).max() < 0.03
    assert np.abs(lines.colour[:, 1] - right).max() < 0.03
    assert lines.polarity.tolist() == np.sign(left.sum(1) - right.sum(1)).tolist()
    assert lines.colour.dtype == np.float32 and lines.polarity.dtype.kind == "i"


@pytest.mark.parametrize("azimuth", (180.0, 179.99, -179.9, 179.3))
def test_a_line_at_the_seam_is_found_once(azimuth):
    lines, _ = bands(sorted([azimuth if azimuth < 180 else -180.0, 20.0]))
    assert len(lines.bearing) == 2
    away = np.abs(turned(lines.bearing - np.radians(azimuth))).min()
    assert away < np.radians(0.05)
    assert ((lines.bearing > -pi) & (lines.bearing <= pi)).all()


@pytest.mark.parametrize(
    ("outer", "middle", "apart"),
    (
        ((190, 190), 90, 1.1),
        ((190, 190), 90, 0.7),
        ((90, 90), 190, 0.7),
        ((90, 190), 140, 1.1),
    ),
)
def test_two_edges_of_a_door_frame_stay_two(outer, middle, apart):
    """Of opposite polarity, and a staircase of equal polarity."""
    azimuth = np.radians([-50.0, 30.0, 30.0 + apart])
    colour = np.repeat([[outer[0]], [middle], [outer[1]]], 3, axis=1)
    image = photograph(stripes(CAMERA, azimuth, colour), 2.0, 0.6)
    lines = extract_lines(image, CAMERA)
    i, j, away = paired(azimuth[1:], lines, np.radians(0.4))
    assert i.tolist() == [0, 1]
    assert np.abs(away).max() < np.radians(0.12)
    assert np.abs(away / lines.sigma[j]).max() < 3


def test_pieces_of_one_line_become_one_unless_told_otherwise():
    azimuth = np.radians([-60.0, 50.0])
    whole = stripes(CAMERA, azimuth, [WHITE, GREY])
    gap = stripes(CAMERA, azimuth, [GREY, GREY], low=0.35, high=0.55, back=(-1.0,) * 3)
    image = photograph(np.where(gap[..., :1] > 0, gap, whole), 2.0, 0.5)
    apart = extract_lines(image, CAMERA, LineSettings(merge=False))
    lines = extract_lines(image, CAMERA)
    assert len(apart.bearing) == 4 and len(lines.bearing) == 2
    assert (lines.low < 0.0).all() and (lines.high > 1.0).all()
    assert (lines.sigma < apart.sigma[[0, 2]]).all()


def test_merging_reaches_over_the_seam_and_minds_polarity_and_gap():
    def pieces(bearing, low, high, polarity):
        n, ones = len(bearing), np.ones(len(bearing))
        colour = np.full((n, 2, 3), 0.5, np.float32)
        colour[:, 0] += 0.1 * np.array(polarity)[:, None]
        return Lines(np.array(bearing), 0.001 * ones, np.array(low), np.array(high),
                     np.array(polarity), colour, ones)  # fmt: skip

    over = merge_pieces(
        pieces([-pi + 0.001, pi - 0.001], [0.0, 0.3], [0.2, 0.5], [1, 1]), 0.005, 0.2
    )
    assert len(over.bearing) == 1
    assert abs(abs(over.bearing[0]) - pi) < 1e-9
    assert (over.low[0], over.high[0]) == (0.0, 0.5)
    for other in (
        pieces([0.0, 0.001], [0.0, 0.3], [0.2, 0.5], [1, -1]),
        pieces([0.0, 0.001], [0.0, 0.9], [0.2, 1.1], [1, 1]),
        pieces([0.0, 0.01], [0.0, 0.3], [0.2, 0.5], [1, 1]),
    ):
        assert len(merge_pieces(other, 0.005, 0.2).bearing) == 2


def test_what_is_not_vertical_is_no_line():
    """Edges that lean by 5 degrees and more, level edges, plain walls with noise, soft shadows."""
    plain = photograph(np.full((480, 640, 3), 120.0), 4.0)
    assert len(extract_lines(plain, CAMERA).bearing) == 0
    view = panorama(CAMERA)
    for lean in (5, 20, 45, 90):
        rows, columns = np.mgrid[: len(view.elevation), : len(view.azimuth)]
        along = (columns - 700) * np.cos(np.radians(lean)) - (rows - 80) * np.sin(
            np.radians(lean)
        ) * 1.6
        world = np.where(np.abs(along)[..., None] < 90, 190, 90).repeat(3, -1).astype(np.float32)
        assert len(extract_lines(_seen(world, view), CAMERA).bearing) == 0, lean
    shade = 120 + 60 * np.sin(6 * view.azimuth)[None, :, None] * np.ones(
        (len(view.elevation), 1, 3)
    )
    assert len(extract_lines(_seen(shade, view), CAMERA).bearing) == 0


def _seen(world, view):
    """The image of a world given as a panorama [H, W, 3]."""

    def colour(direction):
        column = view.column(np.arctan2(direction[..., 1], direction[..., 0]))
        row = view.row(np.arcsin(direction[..., 2]))
        rows = np.clip(np.rint(row), 0, len(view.elevation) - 1).astype(int)
        return world[rows, np.rint(column).astype(int) % len(view.azimuth)]

    return photograph(painted(CAMERA, colour, samples=10), 2.0, 0.6)


def test_turning_on_the_spot_shifts_every_bearing_and_nothing_else():
    azimuth, _ = room_of_stripes(CAMERA, 7)
    colour = np.random.default_rng(7).uniform(40, 220, (30, 3))
    turn = np.radians(33.3)
    before, after = (
        extract_lines(photograph(stripes(camera, azimuth, colour, 0.0, 0.9), 2.0, 0.5), camera)
        for camera in (CAMERA, replace(CAMERA, yaw=-turn))
    )
    # seen by a camera turned by -yaw, the robot's frame stays; so undo it: the sensor turned
    i, j, away = paired(before.bearing, after)
    assert len(i) >= 27
    assert np.sqrt(np.mean(away**2)) < np.radians(0.05)
    assert np.abs(before.low[i] - after.low[j]).max() < 0.06
    assert np.abs(before.colour[i] - after.colour[j]).max() < 0.06
    assert (before.polarity[i] == after.polarity[j]).mean() > 0.95
    robot = extract_lines(
        photograph(stripes(replace(CAMERA, yaw=turn), azimuth, colour, 0.0, 0.9), 2.0, 0.5), CAMERA
    )
    i, j, away = paired(turned(before.bearing - turn), robot)
    assert len(i) >= 27 and np.sqrt(np.mean(away**2)) < np.radians(0.05)


def test_brightness_of_the_light_does_not_matter():
    _, image = room_of_stripes(CAMERA, 3, noise=1.0)
    dim = np.rint(image * 0.4).astype(np.uint8)
    assert (
        abs(len(extract_lines(dim, CAMERA).bearing) - len(extract_lines(image, CAMERA).bearing)) < 3
    )


def test_edges_of_equal_brightness_need_colour():
    azimuth = np.radians([-60.0, 50.0])
    b, g, r = 120.0, 100.0, 140.0
    weights = np.array([0.114, 0.587, 0.299])
    other = np.array([b + 60, g, r]) - 60 * weights[0] * np.array([0, 0, 1 / weights[2]])
    image = photograph(stripes(CAMERA, azimuth, [(b, g, r), other]), 1.0, 0.5)
    assert len(extract_lines(image, CAMERA).bearing) == 2
    assert len(extract_lines(image, CAMERA, LineSettings(colour=False)).bearing) == 0


def test_pushed_pairs_are_moved_together():
    ones = np.ones(2)
    lines = Lines(np.array([0.0, 0.02]), 0.001 * ones, 0 * ones, ones, np.array([1, -1]),
                  np.zeros((2, 2, 3), np.float32), ones)  # fmt: skip
    near = separate_close_pairs(lines, 0.009)
    assert 0 < near.bearing[0] < near.bearing[1] < 0.02
    assert (near.sigma > lines.sigma).all()
    far, same = (
        separate_close_pairs(lines, 0.002),
        separate_close_pairs(lines._replace(polarity=np.ones(2)), 0.009),
    )
    assert np.allclose(far.bearing, lines.bearing) and np.allclose(same.bearing, lines.bearing)


def test_a_dark_frame_gives_no_lines_and_is_told():
    dark = photograph(np.full((480, 640, 3), 3.0), 2.0)
    lines = extract_lines(dark, CAMERA)
    assert is_dark(dark) and not is_dark(room_of_stripes(CAMERA, 0)[1])
    assert [len(field) for field in lines] == [0] * 7
    assert lines.colour.shape == (0, 2, 3)
    black = extract_lines(np.zeros((480, 640, 3), np.uint8), CAMERA)
    assert len(black.bearing) == 0


def test_the_border_of_the_image_is_no_line():
    cropped = replace(CAMERA, height=400, elevation=(-0.08, 1.13))
    azimuth, image = room_of_stripes(CAMERA, 2)
    lines = extract_lines(np.ascontiguousarray(image[:400]), cropped)
    _, j, _ = paired(azimuth, lines)
    assert len(lines.bearing) - len(j) <= 1


def test_both_halves_of_a_line_agree():
    _, image = room_of_stripes(CAMERA, 5)
    upper, lower = halves(image, CAMERA)
    assert len(upper) > 20
    assert np.median(np.abs(turned(upper - lower))) < np.radians(0.03)
    leaning = replace(CAMERA, roll=np.radians(1.0))
    upper, lower = halves(image, leaning)
    assert np.median(np.abs(turned(upper - lower))) > np.radians(0.1)


def test_wrong_sizes_and_settings_are_told():
    with pytest.raises(ValueError, match="64 x 48 pixels; the camera is calibrated for 640 x 480"):
        extract_lines(np.zeros((48, 64, 3), np.uint8), CAMERA)
    for setting in ("length", "contrast", "gap"):
        with pytest.raises(ValueError, match=setting):
            LineSettings(**{setting: 0.0})
    with pytest.raises(ValueError, match="merge_gap"):
        LineSettings(merge_gap=-1.0)


def test_lines_are_drawn_where_they_are():
    lines, image = bands([20.0, 80.0])
    view = panorama(CAMERA)
    picture = unwrap(image, view)
    changed = (draw_lines(picture, lines, view) != picture).any(-1)
    assert set(np.flatnonzero(changed.any(0))) <= {
        int(c) + k for c in view.column(lines.bearing) for k in (-1, 0, 1, 2)
    }
    on_image = (draw_on_image(image, lines, CAMERA) != image).any(-1)
    v, u = np.nonzero(on_image)
    direction = CAMERA.direction(np.stack([u, v], -1).astype(float))
    bearing = np.arctan2(direction[:, 1], direction[:, 0])
    assert np.abs(turned(bearing[:, None] - lines.bearing)).min(1).max() < np.radians(2)
    assert len(v) > 150


@pytest.mark.parametrize(("preset", "most"), (("clean", 0.1), ("hard", 0.15)))
def test_the_rendered_rooms_edges_are_found(preset, most):
    """Bearings against the world's geometry; the issue's limits, on a few frames."""
    camera, world = double_mirror_camera(), furnish(20)
    poses = np.array([(1.3, 1.2, 0.4), (4.1, 0.9, 2.0), (6.2, 3.0, -1.0), (8.6, 2.7, -2.5)])
    drive = SimpleNamespace(pose=poses, command=np.zeros((3, 2)))
    errors, clear, found, false = [], 0, 0, 0
    for image, pose, _ in render_frames(world, camera, drive, PRESETS[preset], seed=20):
        edges, lines = visible_edges(world, pose), extract_lines(image, camera)
        i, _, away = paired(edges.bearing, lines)
        errors.extend(np.degrees(away))
        plain = (edges.contrast >= 0.1) & (edges.high - edges.low >= np.radians(8))
        clear, found = clear + plain.sum(), found + plain[i].sum()
        apart = np.abs(turned(lines.bearing[:, None] - edges.bearing)).min(1)
        false += (apart > np.radians(1)).sum()
    assert np.sqrt(np.mean(np.square(errors))) <= most
    assert found >= 0.8 * clear and clear > 100
    assert false <= 1
