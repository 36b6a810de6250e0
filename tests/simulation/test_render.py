"""The rendered room: edges lie where the geometry says, and the folder holds what it promises."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from jaxslam.simulation.room import render
from jaxslam.simulation.room.furniture import furnish
from jaxslam.simulation.room.geometry import eye_at, trace_rays, visible_edges
from jaxslam.simulation.room.raycast import build_scene, camera_rays, cast, expose
from jaxslam.simulation.room.render import (
    PRESETS,
    Effects,
    double_mirror_camera,
    nominal_camera,
    render_frames,
    render_room,
)
from jaxslam.simulation.room.trajectory import Drive, stop_and_go
from jaxslam.vision.camera_files import load_camera

HEADERS = {
    "frames.csv": "image,time_s",
    "odometry.csv": "time_s,distance_m,turn_rad",
    "poses.csv": "time_s,x_m,y_m,theta_rad",
    "landmarks.csv": "id,x_m,y_m",
    "plan.csv": "x1_m,y1_m,x2_m,y2_m",
    "edges.csv": "id,x_m,y_m,bottom_m,top_m,contrast,kind",
    "visible.csv": "image,id,bearing_rad,distance_m,low_rad,high_rad,contrast",
}
OTHERS = {"images", "camera.toml", "camera_nominal.toml", "room.toml"}


def small():
    """The same camera with a sixteenth of the pixels."""
    camera = double_mirror_camera()
    params = np.append((camera.params[:2] + 0.5) / 4 - 0.5, camera.params[2:])
    return replace(camera, width=160, height=120, params=params)


SHORT = dict(length=0.5, preset="hard", camera=small())


@pytest.fixture(scope="module")
def camera():
    return double_mirror_camera()


@pytest.fixture(scope="module")
def world():
    return furnish(1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("rendered") / "room"
    assert render_room(out, seed=2, length=0.5) == 4
    return out


def test_rays_meet_what_plain_ray_casting_meets(world, camera):
    """The sorted sectors against every ray on every surface; eye above the low furniture too."""
    rays, built = camera_rays(camera, samples=1), build_scene(world)
    rng = np.random.default_rng(0)
    some = np.sort(rng.choice(len(rays.azimuth), 3000, replace=False))
    for pose, height in (((1.0, 1.0, 0.3), 0.6), ((8.0, 3.0, -2.5), 1.5), ((5.2, 1.2, 3.1), 0.6)):
        eye = eye_at(pose, (0.03, 0.02, height))
        found = cast(built, rays, eye, pose[2])[some, :3] / 255
        elevation = np.arctan(rays.slope[some])
        _, colour = trace_rays(world, eye, rays.azimuth[some] + pose[2], elevation)
        off = np.abs(found - colour).max(1) > 0.02
        assert off.mean() < 0.005  # single precision, at borders of the paint


def edge_errors(image, camera, view):
    """Degrees by which the gradient of well visible, single edges is off their true bearing."""
    errors, grey = [], image.mean(-1)
    offset = np.radians(np.arange(-1.2, 1.2001, 0.05))
    for j, bearing in enumerate(view.bearing):
        apart = np.abs((view.bearing - bearing + np.pi) % (2 * np.pi) - np.pi)
        apart[j] = np.inf
        low, high = view.low[j] + 0.02, view.high[j] - 0.02
        if view.contrast[j] < 0.1 or high - low < 0.14 or apart.min() < np.radians(2.5):
            continue
        a, e = np.meshgrid(bearing + offset, np.linspace(low, high, 80))
        ray = np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], -1)
        pixel = camera.project(ray).astype(np.float32)
        across = cv2.remap(grey, pixel[..., 0], pixel[..., 1], cv2.INTER_LINEAR).mean(0)
        slope, near = np.abs(np.gradient(across)), np.abs(offset) < np.radians(0.7)
        weight = np.where(near, slope - slope[near].min(), 0)
        errors.append(np.degrees(np.sum(weight * offset) / np.sum(weight)))
    return errors


def test_edges_are_where_the_geometry_says(world, camera):
    rays, built, errors = camera_rays(camera), build_scene(world), []
    for pose in stop_and_go(seed=1, length=20.0).pose[::7]:
        image = expose(built, rays, eye_at(pose, camera.position), pose[2])
        errors += edge_errors(image, camera, visible_edges(world, pose, camera.position))
    assert len(errors) > 80
    assert np.sqrt(np.mean(np.square(errors))) < 0.05
    assert np.median(np.abs(errors)) < 0.015
    assert abs(np.mean(errors)) < 0.01  # half a pixel would be 0.1


def test_the_camera_sees_from_minus_5_to_65_degrees(camera):
    assert (camera.width, camera.height) == (640, 480)
    azimuth, elevation = np.meshgrid(np.linspace(-3.1, 3.1, 60), np.radians([-5.0, 30.0, 65.0]))
    ray = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation)]
    pixel = camera.project(np.stack([*ray, np.sin(elevation)], -1))
    assert np.isfinite(pixel).all()
    radius = np.hypot(*(pixel - (camera["cx"], camera["cy"])).transpose(2, 0, 1)).mean(1)
    np.testing.assert_allclose(radius[[0, 2]], (232, 60), atol=1.0)
    rays = camera_rays(camera, samples=1)
    share = np.zeros(camera.width * camera.height)
    share[rays.pixel] = rays.share[:, 0]
    inside = share.reshape(camera.height, camera.width)[
        tuple(np.rint(pixel[..., ::-1]).astype(int).reshape(-1, 2).T)
    ]
    np.testing.assert_array_equal(inside, 1)
    assert share[0] == 0 and share.mean() < 0.6


def test_nominal_is_another_camera(camera):
    assumed = nominal_camera(camera)
    assert assumed.roll == assumed.pitch == assumed["p1"] == assumed["e"] == 0
    assert (assumed["cx"], assumed["cy"], assumed["c"]) == (319.5, 239.5, 1)
    azimuth = np.linspace(-3, 3, 50)
    ray = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(50, 0.3)], -1)
    seen = assumed.direction(camera.project(ray))
    off = np.degrees(np.arctan2(seen[:, 1], seen[:, 0]) - azimuth)
    assert 0.5 < np.sqrt(np.mean(off**2)) < 3
    straight = double_mirror_camera(0.0)
    np.testing.assert_allclose(straight.params, nominal_camera(straight).params, atol=1e-12)


def test_effects(world, camera):
    pose, still = np.array([[3.0, 1.0, 0.2]] * 2), np.zeros((1, 2))

    def shoot(effects):
        return [
            image.astype(float)
            for image, _, _ in render_frames(
                world, camera, Drive(pose, still), effects, 5, samples=2
            )
        ]

    clean, again = shoot(PRESETS["clean"])
    np.testing.assert_array_equal(clean, again)
    assert clean.std() > 30
    noisy, other = shoot(PRESETS["clean"]._replace(noise=0.02, dark_noise=0.004))
    middle = (clean > 100) & (clean < 200)
    spread = (noisy - other)[middle].std() / np.sqrt(2) / 255
    assert 0.9 < spread / np.hypot(0.02 * np.sqrt(clean[middle].mean() / 255), 0.004) < 1.1
    assert (noisy - other)[clean < 12].std() < 0.5 * (noisy - other)[middle].std()
    fields, _ = shoot(PRESETS["clean"]._replace(interlace=1.0))
    np.testing.assert_array_equal(fields[::2], clean[::2])
    assert np.abs(fields[1::2] - clean[1::2]).mean() > 0.2
    dim, lit = shoot(PRESETS["hard"])
    assert dim.mean() < 0.7 * clean.mean()
    assert abs(dim.mean() / lit.mean() - 1) > 0.005  # light changes between frames
    coloured, _ = shoot(PRESETS["clean"]._replace(chroma_blur=2.0))
    grey = [cv2.cvtColor(i.astype(np.uint8), cv2.COLOR_BGR2GRAY) for i in (coloured, clean)]
    assert np.abs(grey[0].astype(int) - grey[1]).mean() < 1 < np.abs(coloured - clean).max()


def test_the_folder(folder, camera):
    assert {path.name for path in folder.iterdir()} == set(HEADERS) | OTHERS
    for name, header in HEADERS.items():
        lines = (folder / name).read_text(encoding="utf-8").splitlines()
        assert lines[0] == header
        assert all(len(line.split(",")) == len(header.split(",")) for line in lines)
    names = [line.split(",")[0] for line in (folder / "frames.csv").read_text().split()[1:]]
    assert sorted(path.name for path in (folder / "images").iterdir()) == names
    assert cv2.imread(str(folder / "images" / names[-1])).shape == (480, 640, 3)
    driven = stop_and_go(seed=2, length=0.5)
    written = np.loadtxt(folder / "poses.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(written, np.column_stack([range(4), driven.pose]), atol=1e-6)
    written = np.loadtxt(folder / "odometry.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(written, np.column_stack([range(1, 4), driven.command]), atol=1e-6)
    true, assumed = (load_camera(folder / f"{name}.toml") for name in ("camera", "camera_nominal"))
    np.testing.assert_array_equal(true.params, camera.params)
    assert true.roll == camera.roll and true.position == camera.position
    assert assumed.roll == 0 and not np.array_equal(assumed.params, true.params)


def test_truth_in_the_folder(folder):
    world, pose = furnish(2), stop_and_go(seed=2, length=0.5).pose
    view = visible_edges(world, pose[1])
    table = [line.split(",") for line in (folder / "visible.csv").read_text().splitlines()]
    rows = np.array([row[1:] for row in table if row[0] == "000001.png"], float)
    np.testing.assert_array_equal(rows[:, 0], view.id)
    np.testing.assert_allclose(rows[:, 1:], np.column_stack(view[1:6]), atol=1e-6)
    marks = np.loadtxt(folder / "landmarks.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(marks[:, 1:], world.edges.point[world.edges.landmark], atol=1e-6)


def test_same_seed_same_bytes(tmp_path):
    for name, seed in (("one", 2), ("again", 2), ("other", 3)):
        render_room(tmp_path / name, seed=seed, **SHORT)
    files = [path for path in (tmp_path / "one").rglob("*") if path.is_file()]
    assert len(files) == 4 + len(HEADERS) + len(OTHERS) - 1
    for path in files:
        again, other = (
            tmp_path / name / path.relative_to(tmp_path / "one") for name in ("again", "other")
        )
        assert path.read_bytes() == again.read_bytes()
        same = path.name in ("frames.csv", "camera.toml", "camera_nominal.toml")
        assert same == (path.read_bytes() == other.read_bytes()), path


def test_nothing_is_overwritten_by_accident(tmp_path):
    out = tmp_path / "room"
    render_room(out, seed=1, **SHORT)
    before = (out / "poses.csv").read_bytes()
    with pytest.raises(ValueError, match="exists"):
        render_room(out, seed=2, **SHORT)
    assert (out / "poses.csv").read_bytes() == before
    render_room(out, seed=2, overwrite=True, **SHORT)
    assert (out / "poses.csv").read_bytes() != before
    mine = tmp_path / "mine"
    mine.mkdir()
    with pytest.raises(ValueError, match="not a rendered room"):
        render_room(mine, overwrite=True, **SHORT)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "room"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_what_is_interrupted_leaves_nothing(tmp_path, error):
    def stop(done, total):
        assert total == 4
        if done == 2:
            raise error

    with pytest.raises(error):
        render_room(tmp_path / "room", progress=stop, **SHORT)
    assert not list(tmp_path.iterdir())


def test_what_can_not_be_written_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(render.cv2, "imwrite", lambda *_: False)
    with pytest.raises(ValueError, match=r"000000\.png"):
        render_room(tmp_path / "room", **SHORT)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "wrong",
    [
        dict(seed=-1),
        dict(seed=0.5),
        dict(preset="pretty"),
        dict(drive="circle"),
        dict(step=1.0),
        dict(effects=Effects(blur=-1.0)),
        dict(effects=Effects(noise=float("nan"))),
        dict(effects=Effects(exposure=0.0)),
        dict(shadows=2.0),
    ],
)
def test_bad_arguments(tmp_path, wrong):
    with pytest.raises(ValueError, match=r"allowed|none of") as caught:
        render_room(tmp_path / "room", **{"length": 0.3, **wrong})
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_bad_misalignment():
    with pytest.raises(ValueError, match="misalignment"):
        double_mirror_camera(5.0)
