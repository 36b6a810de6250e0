"""The parameters of the filter: `PARAMETERS` describes each in a row, `Params` holds their values.

A row has default, unit, range, meaning, and how the parameter is learned. Parameter files,
learning, messages and the documentation's table are derived from it.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

from jaxslam.config import SENSORS

if TYPE_CHECKING:
    from jaxslam.logs.log import Log

MOTION, ALTERNATIVES = "motion", "alternatives"  # in `learned_by`, beside the sensors
COMMAND_FLOOR = 0.002  # m/sqrt(s): the error of a commanded step grows with its length, not time


class Parameter(NamedTuple):
    """Description of one parameter.

    - `default`, with other values for some sensors in `of_sensor`.
    - Range from `low` to `high`, both included unless `above_low` or `below_high` is set.
    - Learned on the free scale `scale` (log, logit or linear), in units of `step`, from the
      likelihoods in `learned_by`: `MOTION`, `ALTERNATIVES` (new landmark or clutter), or sensors.
    - `note`: what the documentation adds to `meaning`. `former`: name in version 0.1, still read.
    """

    name: str
    default: float
    unit: str
    meaning: str
    low: float = -math.inf
    high: float = math.inf
    above_low: bool = False
    below_high: bool = False
    scale: str = "log"
    step: float = 1.0
    learned_by: tuple[str, ...] = ()
    of_sensor: dict[str, float] = {}  # noqa: RUF012 (never changed)
    note: str = ""
    former: str | None = None


def _positive(name, default, unit, meaning, **rest):
    return Parameter(name, default, unit, meaning, low=0.0, above_low=True, **rest)


def _not_negative(name, default, unit, meaning, **rest):
    return Parameter(name, default, unit, meaning, low=0.0, **rest)


# Wide enough for a real robot's errors, which are correlated from frame to frame. Tuned by hand on
# the bundled log and MRCLAM dataset 6, with their truth: nothing of these was held out. For
# `position` the motion is tighter: triangulation was tuned with it. A bearing's noise is the
# sensor's own, which refinement uses as it is; the filter, which can't correct a wrong depth later,
# adds `extra_bearing_noise`.
PARAMETERS = (
    _not_negative(
        "err_tran", 0.02, "m/sqrt(m)", "noise along the path, per distance",
        learned_by=(MOTION,), of_sensor={"position": 0.05}, note="standard deviation after 1 m",
    ),
    _not_negative(
        "err_rot", 0.15, "rad/sqrt(rad)", "noise of the heading, per turn",
        learned_by=(MOTION,), of_sensor={"position": 0.05}, note="standard deviation after 1 rad",
    ),
    _not_negative(
        "err_drift", 0.1, "rad/sqrt(m)", "noise of the heading, per distance",
        learned_by=(MOTION,), of_sensor={"position": 0.05}, note="standard deviation after 1 m",
    ),
    _not_negative(
        "floor_tran", 0.015, "m/sqrt(s)", "noise of the position, per time",
        learned_by=(MOTION,), of_sensor={"position": 0.002},
        note="also while the odometry reports no motion",
    ),
    _not_negative(
        "floor_rot", 0.005, "rad/sqrt(s)", "noise of the heading, per time",
        learned_by=(MOTION,), note="also while the odometry reports no motion",
    ),
    _positive(
        "gain_tran", 1.0, "true / measured", "true over measured distance",
        step=0.1, learned_by=(MOTION,),
        note="with bearings alone this is the scale of the map, which they do not determine",
    ),
    _positive(
        "gain_rot", 1.0, "true / measured", "true over measured turn",
        step=0.1, learned_by=(MOTION,),
    ),
    Parameter(
        "bias_drift", 0.0, "rad/m", "systematic turn, per distance",
        scale="linear", step=0.1, learned_by=(MOTION,),
    ),
    _positive(
        "sigma_range", 0.12, "m", "noise of a range", learned_by=("range_bearing",),
        note="`position`: used, like the next two, where positions are made of ranges and bearings",
    ),
    _positive(
        "sigma_bearing", 0.05, "rad", "noise of a bearing, far away",
        learned_by=("range_bearing", "bearing"), of_sensor={"bearing": 0.005},
    ),
    _not_negative(
        "landmark_extent", 0.12, "m", "size of a landmark, as sideways noise", former="growth",
        learned_by=("range_bearing", "bearing"), of_sensor={"bearing": 0.03},
        note="adds extent / range to the noise of a bearing",
    ),
    _positive(
        "position_scale", 1.0, "factor", "multiplies the standard deviations of positions",
        learned_by=("position",), note="of positions that bring their own covariance",
    ),
    _not_negative(
        "correlation", 0.0, "m", "path over which errors are correlated",
        note="0: independent errors",
    ),
    _not_negative(
        "extra_bearing_noise", 0.0, "rad", "bearing noise added by the filter", former="caution",
        of_sensor={"bearing": 0.06}, note="in quadrature; refinement does not",
    ),
    Parameter(
        "mount_x", 0.0, "m", "sensor on the robot, forward",
        scale="linear", step=0.1, learned_by=SENSORS, note="declared by the log",
    ),
    Parameter(
        "mount_y", 0.0, "m", "sensor on the robot, left",
        scale="linear", step=0.1, learned_by=SENSORS, note="declared by the log",
    ),
    Parameter(
        "mount_yaw", 0.0, "rad", "sensor on the robot, counter-clockwise",
        scale="linear", step=0.1, learned_by=SENSORS, note="declared by the log",
    ),
    Parameter(
        "outlier", 0.01, "probability", "that a measurement is clutter",
        low=0.0, high=1.0, below_high=True, scale="logit", learned_by=(ALTERNATIVES,),
        of_sensor={"bearing": 3e-3}, note="uniformly over the view",
    ),
    _positive(
        "density_new", 1e-3, "1/m^2", "density of unmapped landmarks", learned_by=(ALTERNATIVES,),
        note="well below the real density, since it also applies where all have been mapped",
    ),
    Parameter(
        "detection", 0.9, "probability", "detection of a landmark at range 0", low=0.0, high=1.0,
        note="falls linearly to 0 at `view_range`",
    ),
    Parameter(
        "view_min", -math.pi, "rad", "least bearing the sensor sees", low=-math.pi, high=math.pi,
        note="declared by the log",
    ),
    Parameter(
        "view_max", math.pi, "rad", "largest bearing the sensor sees", low=-math.pi, high=math.pi,
        note="declared by the log",
    ),
    _positive(
        "view_range", 10.0, "m", "largest range the sensor sees", note="declared by the log",
    ),
    _positive(
        "inv_depth_mean", 0.4, "1/m", "inverse depth of a new landmark (bearings only)",
        learned_by=("bearing",), note="2.5 m away: for indoors",
    ),
    _positive(
        "inv_depth_sd", 0.25, "1/m", "standard deviation of that inverse depth",
        learned_by=("bearing",), note="two of them span 1.1 m to infinity",
    ),
    Parameter("existence_new", 1.0, "log-odds", "existence of a new landmark", low=0.0),
    _not_negative(
        "existence_seen", 0.5, "log-odds per frame", "added when a landmark is measured",
        note="less than one measurement is worth, since they are not independent",
    ),
    _not_negative(
        "existence_miss", 0.1, "factor", "weight of a missed detection",
        note="low, since landmarks occlude one another",
    ),
    _positive(
        "existence_max", 20.0, "log-odds", "upper limit of existence",
        note="so that a landmark that is gone is forgotten",
    ),
    Parameter("existence_confirm", 5.0, "log-odds", "from here on a landmark is in the map"),
)  # fmt: skip
TABLE = {parameter.name: parameter for parameter in PARAMETERS}
FORMER_NAMES = {row.former: row.name for row in PARAMETERS if row.former}


class Params(NamedTuple):
    """Values of the parameters, floats or 0-d arrays; `PARAMETERS` has units and meanings.

    Motion noise grows with what was driven: variance `err_tran**2` per metre, `err_rot**2` per
    radian turned, `err_drift**2` rad^2 per metre, and the floors per second. Gains are true over
    measured odometry. The variance of a bearing is
    `sigma_bearing**2 + (landmark_extent / range)**2`: a tube or a door edge has a size. Errors of
    one landmark's measurements are correlated over a path of `correlation`, so that standing still
    gives no new information (0: independent). The filter adds `extra_bearing_noise` in quadrature,
    since its particles are few and errors less independent than it assumes; refinement does not.
    """

    err_tran: float
    err_rot: float
    err_drift: float
    floor_tran: float
    floor_rot: float
    gain_tran: float
    gain_rot: float
    bias_drift: float
    sigma_range: float
    sigma_bearing: float
    landmark_extent: float
    position_scale: float
    correlation: float
    extra_bearing_noise: float
    mount_x: float
    mount_y: float
    mount_yaw: float
    outlier: float
    density_new: float
    detection: float
    view_min: float
    view_max: float
    view_range: float
    inv_depth_mean: float
    inv_depth_sd: float
    existence_new: float
    existence_seen: float
    existence_miss: float
    existence_max: float
    existence_confirm: float

    @property
    def growth(self) -> float:
        """`landmark_extent` by its name of version 0.1."""
        return self.landmark_extent

    @property
    def caution(self) -> float:
        """`extra_bearing_noise` by its name of version 0.1."""
        return self.extra_bearing_noise


def current_names(values):
    """Replace names of version 0.1 in a dict by today's names."""
    return {FORMER_NAMES.get(name, name): value for name, value in values.items()}


def learned_by(likelihood):
    """List the parameters on which a likelihood depends, in their order."""
    return tuple(row.name for row in PARAMETERS if likelihood in row.learned_by)


def default_params(sensor: str = "range_bearing", log: "Log | None" = None) -> "Params":
    """Make the default `Params` of a sensor, with the odometry, mounting, view and noise that a
    log declares.

    Raises `ValueError` for a sensor that is not one of `SENSORS`.
    """
    if sensor not in SENSORS:
        raise ValueError(f"sensor: {sensor!r} is not one of {', '.join(SENSORS)}")
    params = Params(*(row.of_sensor.get(sensor, row.default) for row in PARAMETERS))
    if log is None:
        return params
    names = ("mount_x", "mount_y", "mount_yaw", "view_min", "view_max", "view_range")
    params = params._replace(**dict(zip(names, (*log.mounting, *log.view), strict=True)))
    if log.odometry_kind == "command":
        params = params._replace(floor_tran=COMMAND_FLOOR)
    return params._replace(**current_names(log.noise))
