"""Bearing-only FastSLAM as a JAX-vectorised filter.

    log = jaxslam.load_log("lost-in-the-woods")
    result = jaxslam.run(log, seed=0)
    result.save("runs/woods")
    fit = jaxslam.learn.fit([log], config, params, ["err_rot"])

Names are looked up when first used, so that `import jaxslam` does not import JAX.
"""

import importlib

_WHERE = {
    "Config": "config",
    "Params": "parameters",
    "default_params": "parameters",
    "load_params": "parameter_file",
    "save_params": "parameter_file",
    "Log": "logs.log",
    "Truth": "logs.log",
    "FloorPlan": "logs.log",
    "load_log": "logs.log_file",
    "cut": "logs.slicing",
    "windows": "logs.slicing",
    "spaced": "logs.slicing",
    "save_log": "logs.log_file",
    "read": "logs.readers",
    "config_for": "runs.run",
    "run": "runs.run",
    "Result": "results.result",
    "init": "filter.step",
    "step": "filter.step",
    "State": "filter.step",
    "Info": "filter.step",
    "load_result": "results.load",
    "errors": "results.metrics",
    "planar": "simulation.planar",
    "Camera": "vision.camera",
    "load_camera": "vision.camera_files",
    "save_camera": "vision.camera_files",
    "extract_lines": "vision.lines",
    "extract": "vision.extract",
    "triangulate_log": "vision.log_triangulation",
    "render_room": "simulation.room.render",
}
_MODULES = {
    "learn": "learning.fit",
    "likelihood": "learning.likelihood",
    "uncertainty": "learning.uncertainty",
}
__version__ = "0.1.0"
__all__ = sorted([*_WHERE, *_MODULES])


def __getattr__(name):
    if name in _MODULES:
        return importlib.import_module(f"jaxslam.{_MODULES[name]}")
    if name not in _WHERE:
        raise AttributeError(f"module 'jaxslam' has no attribute {name!r}")
    module = importlib.import_module(f"jaxslam.{_WHERE[name]}")
    return getattr(module, "compute_errors" if name == "errors" else name)


def __dir__():
    return sorted([*globals(), *__all__])
