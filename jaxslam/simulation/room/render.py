"""Render a drive through a room: images of a mirror camera on the robot, and the exact truth.

`furniture` draws the room, `trajectory` the drive, `raycast` makes ideal images. This module adds
the flaws of a camera and writes all into a folder like that of a real drive. Images are uint8
[H, W, 3], blue, green, red; before that, colours are a video signal of 0..1.
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
from jaxslam.simulation.room.raycast import build_scene, camera_rays, expose
from jaxslam.simulation.room.trajectory import stop_and_go
from jaxslam.vision.camera import Camera
from jaxslam.vision.camera_files import save_camera

SECONDS = 1.0  # s from stop to stop
PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]  # noise does not compress any better


class Effects(NamedTuple):
    """Flaws of an image: standard deviations unless stated otherwise."""

    exposure: float = 1.0  # mean brightness, relative
    brightness: float = 0.06  # of the light, from frame to frame, relative
    colour: float = 0.03  # of the light's colour and the white balance, relative
    shading: float = 0.04  # of light from one side, another side each frame
    noise: float = 0.012  # of a white pixel; shot noise: its square is proportional to the signal
    dark_noise: float = 0.004  # of a black pixel
    blur: float = 0.6  # px, of the optics
    chroma_blur: float = 1.0  # px, along the rows, of colour only
    interlace: float = 0.0  # px, shift of the odd rows by shaking


MOST = Effects(2.0, 0.5, 0.3, 0.3, 0.3, 0.3, 10.0, 20.0, 5.0)._asdict()
PRESETS = {
    "clean": Effects(
        brightness=0, colour=0, shading=0, noise=0, dark_noise=0, blur=0, chroma_blur=0
    ),
    "normal": Effects(),
    "hard": Effects(0.4, 0.12, 0.06, 0.08, 0.025, 0.010, 1.1, 2.0),
}


def double_mirror_camera(misalignment=1.0):
    """Make the camera of the rendered room: 640 x 480, two mirrors, elevations -5 to 65 degrees.

    The zenith is in the middle, the horizon near the rim; two reflections preserve the sense of
    azimuth. `misalignment` scales the errors of centre, affine map, decentring and tilt.
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
    mounting: dict = {"yaw": math.pi / 2, "position": (0.0, 0.0, 0.6), "elevation": VIEW}
    return Camera(640, 480, "polynomial", np.array(params), **mounting, **tilt)


def nominal_camera(camera):
    """The camera as assumed without calibration: centred, aligned and level."""
    params = np.array(camera.params)
    params[:7] = (camera.width - 1) / 2, (camera.height - 1) / 2, 1, 0, 0, 0, 0
    mounting = {"yaw": camera.yaw, "position": camera.position, "elevation": camera.elevation}
    return Camera(camera.width, camera.height, camera.model, params, **mounting)


def render_frames(world, camera, drive, effects=PRESETS["normal"], seed=0, samples=8):
    """Yield (image, true pose, command before it) for every stop of a `Drive`.

    The first command is None. An image depends only on the seed, its number and its pose.
    """
    rays, scene = camera_rays(camera, samples), build_scene(world)
    light = _Light(seed)
    for k, pose in enumerate(drive.pose):
        command = drive.command[k - 1] if k else None
        yield _render_image(scene, rays, camera, pose, effects, light, k), pose, command


class _Light:
    """Light that changes slowly, as sums of waves, and a little at random each frame."""

    def __init__(self, seed):
        rng = np.random.default_rng([seed, 2])
        self.seed = seed
        # rad per frame, of the brightness and of three colours
        self.rate = 2 * math.pi / rng.uniform(15, 150, (4, 5))
        self.phase = rng.uniform(-math.pi, math.pi, (4, 5))

    def at(self, k, effects, azimuth, rng):
        """Draw the light [P, 3] in frame `k` on pixels at azimuths [P] of the world."""
        slow = np.sqrt(2 / 5) * np.sin(self.rate * k + self.phase).sum(-1)
        wave = 0.9 * slow + 0.43 * rng.standard_normal(4)  # unit variance
        turned = np.cos(azimuth - rng.uniform(-math.pi, math.pi))
        side = 1 + effects.shading * rng.standard_normal() * turned
        gain = np.exp(effects.brightness * wave[0] + effects.colour * wave[1:]) * effects.exposure
        return side[:, None].astype(np.float32) * gain.astype(np.float32)


def _render_image(scene, rays, camera, pose, effects, light, k):
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
    drive: str = "loop",  # loop: round the room; straight: along a wall; turn: on the spot
    step: float = 0.2,  # m between images
    length: float | None = None,  # m at least (turn: rad); None: loop 60, straight 6, turn 2 pi
    preset: str = "normal",  # clean, normal or hard
    effects: Effects | None = None,  # `Effects`, instead of the preset's
    slip: float = 0.025,  # mean fraction of distance lost by wheel slip
    turn_error: float = 0.02,  # standard deviation of a turn's relative error
    drift: float = 0.01,  # rad/sqrt m
    shadows: float = 1.0,  # 0 to 1: darkness where surfaces meet
    plain: float = 0.2,  # 0 to 1: share of the furniture painted like the wall
    camera: Camera | None = None,  # None: `double_mirror_camera()`
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,  # called with (images done, total)
) -> int:
    """Write a drive through a rendered room into the folder `out`; returns the number of images.

    - images/000000.png ... with frames.csv; odometry.csv (commands); camera.toml, and
      camera_nominal.toml without calibration.
    - Truth: poses.csv, landmarks.csv, plan.csv, edges.csv (all vertical edges, also low ones;
      `contrast` is the mean over the images that show it), visible.csv (each visible edge in each
      image).
    - room.toml: the settings.

    The folder appears complete or not at all. Raises `ValueError`.
    """
    camera = double_mirror_camera() if camera is None else camera
    effects = _preset_effects(preset) if effects is None else effects
    _check(seed, effects)
    settings = {"seed": seed, "drive": drive, "step": step, "length": length, "preset": preset}
    settings |= {"slip": slip, "turn_error": turn_error, "drift": drift}
    settings |= {"shadows": shadows, "plain": plain}
    driven = stop_and_go(
        drive, seed, step=step, length=length, slip=slip, turn_error=turn_error, drift=drift
    )
    world = furnish(seed, shadows=shadows, plain=plain)
    target = _target_folder(out, overwrite)
    partial = temporary_sibling(target)
    try:
        (partial / "images").mkdir(parents=True)
        _write_drive(partial, world, driven, camera, effects, seed, progress)
        lines = [f"{name} = {json.dumps(v)}" for name, v in settings.items() if v is not None]
        lines += ["", "[effects]", *(f"{k} = {v!r}" for k, v in effects._asdict().items())]
        _write_lines(partial / "room.toml", lines)
        move_folder(partial, target, overwrite)
    except OSError as error:
        if error.errno == errno.ENOSPC:
            raise
        raise ValueError(f"{out}: can't be written ({error.strerror}); choose another") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return len(driven.pose)


def _write_drive(folder, world, driven, camera, effects, seed, progress):
    """Write all but the settings, with one image at a time in memory."""
    count = len(driven.pose)
    seen, contrast = np.zeros(len(world.edges.kind)), np.zeros(len(world.edges.kind))
    with open(folder / "visible.csv", "w", encoding="utf-8", newline="\n") as file:
        file.write("image,id,bearing_rad,distance_m,low_rad,high_rad,contrast\n")
        for k, (image, pose, _) in enumerate(render_frames(world, camera, driven, effects, seed)):
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
    save_camera(folder / "camera_nominal.toml", nominal_camera(camera))
    _write_truth(folder, world, driven, contrast / np.maximum(seen, 1))


def _write_truth(folder, world, driven, contrast):
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
        _write_lines(folder / name, [header, *(",".join(_cell(v) for v in row) for row in rows)])


def _cell(value):
    return f"{value:.6f}" if isinstance(value, float) else str(value)


def _write_lines(path, lines):
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8", newline="\n")


def _target_folder(out, overwrite):
    """Resolve the folder to write; only a rendered room may be overwritten."""
    target = Path(out).resolve()
    if os.path.lexists(target):
        if not overwrite:
            raise ValueError(f"{out}: exists; choose another folder or add --overwrite")
        if not (target / "room.toml").is_file():
            raise ValueError(f"{out}: is not a rendered room, so it is not overwritten")
    return target


def _preset_effects(preset):
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
