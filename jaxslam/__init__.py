"""FastSLAM in JAX: a landmark map and the robot's trajectory from odometry and measurements.

    log = jaxslam.load_log("lost-in-the-woods")
    result = jaxslam.run(log, seed=0)
    result.save("runs/woods")
    fit = jaxslam.learn.fit([log], config, params, ["err_rot"])

Names are looked up at first use, so that `import jaxslam` does not import JAX.
"""

import importlib
from typing import TYPE_CHECKING

__version__ = "0.2.0.dev0"

_PUBLIC = {  # name: module, or module:attribute
    # Settings
    "Config": "config:Config",
    "Params": "parameters:Params",
    "default_params": "parameters:default_params",
    "load_params": "parameter_file:load_params",
    "save_params": "parameter_file:save_params",
    # Logs
    "Log": "logs.log:Log",
    "Truth": "logs.log:Truth",
    "FloorPlan": "logs.log:FloorPlan",
    "load_log": "logs.log_file:load_log",
    "save_log": "logs.log_file:save_log",
    "cut": "logs.slicing:cut",
    "windows": "logs.slicing:windows",
    "spaced": "logs.slicing:spaced",
    "read": "logs.readers:read",
    # Runs and results
    "config_for": "runs.run:config_for",
    "run": "runs.run:run",
    "Result": "results.result:Result",
    "load_result": "results.load:load_result",
    "errors": "results.metrics:compute_errors",
    # The filter, step by step
    "init": "filter.step:init",
    "step": "filter.step:step",
    "State": "filter.step:State",
    "Info": "filter.step:Info",
    "Odometry": "logs.odometry:Odometry",
    "Measurements": "models.sensors:Measurements",
    # Learning
    "learn": "learning.fit",
    "likelihood": "learning.likelihood",
    "uncertainty": "learning.uncertainty",
    # Images and simulation
    "Camera": "vision.camera:Camera",
    "load_camera": "vision.camera_files:load_camera",
    "save_camera": "vision.camera_files:save_camera",
    "extract_lines": "vision.lines:extract_lines",
    "extract": "vision.extract:extract",
    "triangulate_log": "vision.log_triangulation:triangulate_log",
    "planar": "simulation.planar:planar",
    "render_room": "simulation.room.render:render_room",
}
__all__ = [
    "Camera", "Config", "FloorPlan", "Info", "Log", "Measurements", "Odometry", "Params", "Result",
    "State", "Truth", "config_for", "cut", "default_params", "errors", "extract", "extract_lines",
    "init", "learn", "likelihood", "load_camera", "load_log", "load_params", "load_result",
    "planar", "read", "render_room", "run", "save_camera", "save_log", "save_params", "spaced",
    "step", "triangulate_log", "uncertainty", "windows",
]  # fmt: skip

if TYPE_CHECKING:  # type checkers and editors do not look names up in `_PUBLIC`
    from jaxslam.config import Config
    from jaxslam.filter.step import Info, State, init, step
    from jaxslam.learning import fit as learn
    from jaxslam.learning import likelihood, uncertainty
    from jaxslam.logs.log import FloorPlan, Log, Truth
    from jaxslam.logs.log_file import load_log, save_log
    from jaxslam.logs.odometry import Odometry
    from jaxslam.logs.readers import read
    from jaxslam.logs.slicing import cut, spaced, windows
    from jaxslam.models.sensors import Measurements
    from jaxslam.parameter_file import load_params, save_params
    from jaxslam.parameters import Params, default_params
    from jaxslam.results.load import load_result
    from jaxslam.results.metrics import compute_errors as errors
    from jaxslam.results.result import Result
    from jaxslam.runs.run import config_for, run
    from jaxslam.simulation.planar import planar
    from jaxslam.simulation.room.render import render_room
    from jaxslam.vision.camera import Camera
    from jaxslam.vision.camera_files import load_camera, save_camera
    from jaxslam.vision.extract import extract
    from jaxslam.vision.lines import extract_lines
    from jaxslam.vision.log_triangulation import triangulate_log

else:

    def __getattr__(name):
        if name not in _PUBLIC:
            raise AttributeError(f"module 'jaxslam' has no attribute {name!r}")
        module, _, attribute = _PUBLIC[name].partition(":")
        found = importlib.import_module(f"jaxslam.{module}")
        return getattr(found, attribute) if attribute else found


def __dir__():
    return sorted([*globals(), *__all__])
