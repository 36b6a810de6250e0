"""A rendered room: images of a mirror camera that is driven round it, and the exact truth.

The room is drawn (`furnish`), driven (`drive`), seen (`raycast`); here a camera's flaws are added
and all is written into a folder, as a real drive would leave it. Images are uint8 [H, W, 3], blue,
green, red; before that, colours are a video signal of 0..1.
"""

import errno
import json
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from jaxslam.files import move_folder, temporary_sibling
from jaxslam.simulation.room.furniture import furnish
from jaxslam.simulation.room.geometry import VIEW, eye_at, visible_edges
from jaxslam.simulation.room.raycast import camera_rays, expose, scene
from jaxslam.simulation.room.trajectory import stop_and_go
from jaxslam.vision.camera import Camera
from jaxslam.vision.camera_files import save_camera

SECONDS = 1.0  # s from stop to stop
PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]  # noise does not get smaller by trying harder


class Effects(NamedTuple):
    """What is wrong with an image. Standard deviations where not said otherwise."""

    exposure: float = 1.0  # mean brightness, of 1
    brightness: float = 0.06  # of the light, from frame to frame, relative
    colour: float = 0.03  # of the light's colour and the white balance, relative
    shading: float = 0.04  # of light that comes from one side, another one each frame
    noise: float = 0.012  # of a white pixel; shot noise, so its square goes with the signal
    dark_noise: float = 0.004  # of a black one
    blur: float = 0.6  # px, of the optics
    chroma_blur: float = 1.0  # px, along the rows, of the colour alone
    interlace: float = 0.0  # px, by which a shake moves the odd rows' field


MOST = Effects(2.0, 0.5, 0.3, 0.3, 0.3, 0.3, 10.0, 20.0, 5.0)._asdict()
PRESETS = {
    "clean": Effects(
        brightness=0, colour=0, shading=0, noise=0, dark_noise=0, blur=0, chroma_blur=0
    ),
    "normal": Effects(),
    "hard": Effects(0.4, 0.12, 0.06, 0.08, 0.025, 0.010, 1.1, 2.0),
}


def double_mirror_camera(misalignment=1.0):
    """The camera of the rendered room: 640 x 480, seen by two mirrors, from -5 to 65 degrees.

    The zenith is in the middle, the horizon near the rim, and two reflections leave the sense of
    azimuth. `misalignment` scales all that is not as it should be: centre, affine map, decentring
    and tilt.
    """
    if not 0 <= misalignment <= 2:
        raise ValueError(f"double_mirror_camera: misalignment is {misalignment!r}, allowed: 0 to 2")
    m = misalignment
    rho = np.linspace(0.01, 0.76, 200)
    zenith = (25 + (rho * 320 - 60) * 70 / 172) * math.pi / 180  # 60 px at 65 degrees, 232 px at -5
    powers = rho[:, None] ** np.array([0, 2, 3, 4])
    shape = np.linalg.lstsq(powers * np.sin(zenith)[:, None], rho * np.cos(zenith), rcond=None)[0]
    centre, affine = (319.5 + 3.2 * m, 239.5 - 1.9 * m), (1 + 0.0030 * m, 0.0008 * m, 0.0008 * m)
    params = (*centre, *affine, 0.0012 * m, -0.0016 * m, *shape)
    tilt = {"roll": np.radians(0.6) * m, "pitch": np.radians(-0.45) * m}
    place: dict = {"yaw": math.pi / 2, "position": (0.0, 0.0, 0.6), "elevation": VIEW}
    return Camera(640, 480, "polynomial", np.array(params), **place, **tilt)


def nominal(camera):
    """What one would assume of this camera without calibrating it."""
    params = np.array(camera.params)
    params[:7] = (camera.width - 1) / 2, (camera.height - 1) / 2, 1, 0, 0, 0, 0
    same = {"yaw": camera.yaw, "position": camera.position, "elevation": camera.elevation}
    return Camera(camera.width, camera.height, camera.model, params, **same)


def frames(world, camera, drive, effects=PRESETS["normal"], seed=0, samples=8):
    """Yield (image, true pose, command that led there) for every stop of a `Drive`.

    The first has no command: None. An image depends on the seed, its number and its pose alone.
    """
    rays, built = camera_rays(camera, samples), scene(world)
    light = _Light(seed)
    for k, pose in enumerate(drive.pose):
        command = drive.command[k - 1] if k else None
        yield _shoot(built, rays, camera, pose, effects, light, k), pose, command


class _Light:
    """How the light changes: slowly, as sums of waves, and a little anew each frame."""

    def __init__(self, seed):
        rng = np.random.default_rng([seed, 2])
        self.seed = seed
        # rad a frame, of the brightness and of three colours
        self.rate = 2 * math.pi / rng.uniform(15, 150, (4, 5))
        self.phase = rng.uniform(-math.pi, math.pi, (4, 5))

    def at(self, k, effects, azimuth, rng):
        """Light [P, 3] in frame `k` on pixels at these azimuths [P] of the world."""
        slow = np.sqrt(2 / 5) * np.sin(self.rate * k + self.phase).sum(-1)
        wave = 0.9 * slow + 0.43 * rng.standard_normal(4)  # unit variance
        turned = np.cos(azimuth - rng.uniform(-math.pi, math.pi))
        side = 1 + effects.shading * rng.standard_normal() * turned
        gain = np.exp(effects.brightness * wave[0] + effects.colour * wave[1:]) * effects.exposure
        return side[:, None].astype(np.float32) * gain.astype(np.float32)


def _shoot(scene, rays, camera, pose, effects, light, k):
    rng = np.random.default_rng([light.seed, 3, k])
    on = light.at(k, effects, rays.side + pose[2], rng)
    image = expose(scene, rays, eye_at(pose, camera.position), pose[2], on)
    if effects.blur:
        image = cv2.GaussianBlur(image, (0, 0), effects.blur)
    if effects.interlace:
        dx, dy = effects.interlace * rng.standard_normal(2)
        shaken = cv2.warpAffine(
            image, np.array([[1, 0, dx], [0, 1, dy]], np.float32), image.shape[1::-1]
        )
        image[1::2] = shaken[1::2]
    if effects.noise or effects.dark_noise:
        spread = np.sqrt(effects.dark_noise**2 + effects.noise**2 * np.maximum(image, 0))
        image += spread * rng.standard_normal(image.shape, np.float32)
    if effects.chroma_blur:
        parts = cv2.cvtColor(image, cv2.COLOR_BGR2YCrCb)
        colour = parts[..., 1:].copy()
        parts[..., 1:] = cv2.GaussianBlur(colour, (0, 1), effects.chroma_blur, sigmaY=1e-6)
        image = cv2.cvtColor(parts, cv2.COLOR_YCrCb2BGR)
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)


def render_room(
    out: str | Path,
    seed: int = 0,  # draws the room, the drive, the light and the noise
    *,
    drive: str = "loop",  # loop: rounds; straight: along a wall; turn: on the spot
    step: float = 0.2,  # m from image to image
    length: float
    | None = None,  # m at least; None: 60 round and round, 6 straight; rad of a turn: a whole one
    preset: str = "normal",  # clean, normal or hard
    effects: Effects | None = None,  # instead of the preset's
    slip: float = 0.025,  # mean share of every distance that wheels lose
    turn_error: float = 0.02,  # standard deviation of a turn's relative error
    drift: float = 0.01,  # rad/sqrt m
    shadows: float = 1.0,  # 0 to 1: how dark it is where things meet
    plain: float = 0.2,  # 0 to 1: the share of the furniture that hardly differs from the wall
    camera: Camera | None = None,  # None: `double_mirror_camera()`
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,  # images done, images in all
) -> int:
    """Write a drive through a rendered room into the folder `out`; the number of images.

    images/000000.png ... and frames.csv, odometry.csv (commands), camera.toml and
    camera_nominal.toml (what one would assume without calibration); the truth: poses.csv,
    landmarks.csv, plan.csv, edges.csv (all vertical edges, the lower ones too; `contrast` is the
    mean over the images that saw it) and visible.csv (every edge's bearing in every image);
    room.toml (the settings). All of it appears at once, or nothing does. Raises `ValueError`.
    """
    camera = double_mirror_camera() if camera is None else camera
    effects = _effects(preset) if effects is None else effects
    _check(seed, effects)
    settings = {"seed": seed, "drive": drive, "step": step, "length": length, "preset": preset}
    settings |= {"slip": slip, "turn_error": turn_error, "drift": drift}
    settings |= {"shadows": shadows, "plain": plain}
    driven = stop_and_go(
        drive, seed, step=step, length=length, slip=slip, turn_error=turn_error, drift=drift
    )
    world = furnish(seed, shadows=shadows, plain=plain)
    target = _target(out, overwrite)
    partial = temporary_sibling(target)
    try:
        (partial / "images").mkdir(parents=True)
        _write(partial, world, driven, camera, effects, seed, progress)
        lines = [f"{name} = {json.dumps(v)}" for name, v in settings.items() if v is not None]
        lines += ["", "[effects]", *(f"{k} = {v!r}" for k, v in effects._asdict().items())]
        _text(partial / "room.toml", lines)
        move_folder(partial, target, overwrite)
    except OSError as error:
        if error.errno == errno.ENOSPC:
            raise
        raise ValueError(f"{out}: can't be written ({error.strerror}); choose another") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return len(driven.pose)


def _write(folder, world, driven, camera, effects, seed, progress):
    """All but the settings; one image at a time is in memory."""
    count = len(driven.pose)
    seen, contrast = np.zeros(len(world.edges.kind)), np.zeros(len(world.edges.kind))
    with open(folder / "visible.csv", "w", encoding="utf-8", newline="\n") as file:
        file.write("image,id,bearing_rad,distance_m,low_rad,high_rad,contrast\n")
        for k, (image, pose, _) in enumerate(frames(world, camera, driven, effects, seed)):
            name = f"{k:06d}.png"
            if not cv2.imwrite(str(folder / "images" / name), image, PNG):
                raise OSError(0, f"images/{name} can't be written")
            view = visible_edges(world, pose, camera.position, camera.elevation)
            np.add.at(seen, view.id, 1)
            np.add.at(contrast, view.id, view.contrast)
            for row in zip(view.id, *view[1:6], strict=True):
                file.write(f"{name},{row[0]}," + ",".join(f"{v:.6f}" for v in row[1:]) + "\n")
            if progress:
                progress(k + 1, count)
    save_camera(folder / "camera.toml", camera)
    save_camera(folder / "camera_nominal.toml", nominal(camera))
    _truth(folder, world, driven, contrast / np.maximum(seen, 1))


def _truth(folder, world, driven, contrast):
    time = np.arange(len(driven.pose)) * SECONDS
    edges, tall = world.edges, np.flatnonzero(world.edges.landmark)
    bounds = (edges.bottom, edges.top, contrast)
    tables = {
        "frames.csv": ("image,time_s", [f"{k:06d}.png" for k in range(len(time))], time),
        "odometry.csv": ("time_s,distance_m,turn_rad", time[1:], *driven.command.T),
        "poses.csv": ("time_s,x_m,y_m,theta_rad", time, *driven.pose.T),
        "landmarks.csv": ("id,x_m,y_m", tall, *edges.point[tall].T),
        "plan.csv": ("x1_m,y1_m,x2_m,y2_m", *world.plan.T),
        "edges.csv": (
            "id,x_m,y_m,bottom_m,top_m,contrast,kind",
            *(np.arange(len(contrast)), *edges.point.T, *bounds, edges.kind),
        ),
    }
    for name, (header, *columns) in tables.items():
        rows = zip(*columns, strict=True)
        _text(folder / name, [header, *(",".join(_cell(v) for v in row) for row in rows)])


def _cell(value):
    return f"{value:.6f}" if isinstance(value, float) else str(value)


def _text(path, lines):
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8", newline="\n")


def _target(out, overwrite):
    """The folder to be made; only a rendered room is overwritten."""
    target = Path(out).resolve()
    if os.path.lexists(target):
        if not overwrite:
            raise ValueError(f"{out}: exists; choose another folder or add --overwrite")
        if not (target / "room.toml").is_file():
            raise ValueError(f"{out}: is not a rendered room, so it is not overwritten")
    return target


def _effects(preset):
    if preset not in PRESETS:
        raise ValueError(f"render: preset {preset!r} is none of {', '.join(PRESETS)}")
    return PRESETS[preset]


def _check(seed, effects):
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ValueError(f"render: seed is {seed!r}, allowed: a whole number, 0 or more")
    for name, value in effects._asdict().items():
        if not 0 <= value <= MOST[name]:
            raise ValueError(f"render: {name} is {value!r}, allowed: 0 to {MOST[name]:g}")
    if not effects.exposure:
        raise ValueError("render: exposure is 0, allowed: above 0")
