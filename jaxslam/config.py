"""What a run is told: `Config` (static, decides shapes and branches) and `Params` (numbers).

A value that changes a shape or a branch belongs to `Config`; one that changes a number, and could
be learnt, to `Params`.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

SENSORS = ("position", "range_bearing", "bearing")
ASSOCIATIONS = ("maximum_likelihood", "known", "sampled")
PROPOSALS = ("prior", "informed")
REJUVENATE = 3.0  # m


@dataclass(frozen=True)
class Config:
    """Static settings of the filter; one compilation per distinct `Config`.

    `proposal`: poses are drawn from the motion alone (`prior`, FastSLAM 1.0) or from motion times
    measurements (`informed`, 2.0). `association`: see `association`.
    `resample_threshold` t: resample when ESS < t * particles (0: never, 1 or more: every frame).
    `exclusive`: two measurements of one frame never share a landmark. `clutter`: a measurement may
    come from nothing. `forgetting`: landmarks carry an existence log-odds and are freed below zero
    (None: on, unless identities are known). `even`: of n landmarks in view each is as likely
    beforehand to be the one measured, so that a match counts 1 / n; without it a landmark held
    twice would be twice as likely (`sampled` only). `block`: particles worked on at once, so that
    temporaries stay in cache; `lazy`: landmarks are copied to a particle's descendants when next
    looked at, with at most `chains` ancestries to keep; `devices`: how many share the particles,
    evenly. None of these four makes a difference to the result. `rejuvenate`: metres of driving
    after which a run's particles are redrawn from their refined past (`rejuvenation`; 0: never;
    None: 3 for bearings whose identities are hidden, else never). `descriptors`: coordinates of a
    measurement's looks that help to associate (`looks`; 0: none).

    Raises `ValueError` for a value that is not allowed.
    """

    sensor: str = "range_bearing"
    association: str = "maximum_likelihood"
    particles: int = 1000
    landmarks: int = 64
    measurements: int = 16
    resample_threshold: float = 0.5
    exclusive: bool = True
    clutter: bool = True
    forgetting: bool | None = None
    proposal: str = "prior"
    even: bool = False
    block: int = 512
    lazy: bool = True
    chains: int = 16
    devices: int = 1
    rejuvenate: float | None = None
    descriptors: int = 0

    def __post_init__(self):
        for name, allowed in (
            ("sensor", SENSORS),
            ("association", ASSOCIATIONS),
            ("proposal", PROPOSALS),
        ):
            value = getattr(self, name)
            if value not in allowed:
                raise ValueError(f"Config.{name}: {value!r} is not one of {', '.join(allowed)}")
        for name in ("particles", "landmarks", "measurements", "block", "chains", "devices"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"Config.{name}: {value!r} is not a whole number of at least 1")
        looks = self.descriptors
        if isinstance(looks, bool) or not isinstance(looks, int) or looks < 0:
            raise ValueError(f"Config.descriptors: {looks!r} is not a whole number of at least 0")
        if looks and self.association == "known":
            raise ValueError("Config.descriptors: identities are known, so looks decide nothing")
        if self.particles % self.devices:
            even = self.particles // self.devices * self.devices
            raise ValueError(
                f"Config.devices: {self.particles} particles are not shared evenly by "
                f"{self.devices}; {even or self.devices} or {even + self.devices} are"
            )
        threshold = self.resample_threshold
        if not isinstance(threshold, (int, float)) or not 0 <= threshold < math.inf:
            raise ValueError(f"Config.resample_threshold: {threshold!r} is not a number >= 0")
        if self.rejuvenate is None:
            alone = self.sensor == "bearing" and self.association == "maximum_likelihood"
            object.__setattr__(self, "rejuvenate", REJUVENATE if alone else 0.0)
        every = self.rejuvenate
        if (
            isinstance(every, bool)
            or not isinstance(every, (int, float))
            or not 0 <= every < math.inf
        ):
            raise ValueError(f"Config.rejuvenate: {every!r} is not a number of metres >= 0")
        if self.forgetting is None:
            object.__setattr__(self, "forgetting", self.association != "known")
        for name in ("exclusive", "clutter", "forgetting", "even", "lazy"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"Config.{name}: {getattr(self, name)!r} is not true or false")

        if self.even and self.association != "sampled":
            raise ValueError(f"Config.even: is for association sampled, not {self.association}")

    @classmethod
    def paper(cls, particles=1000, landmarks=64, measurements=16, **changes):
        """The paper's own rules: 2-D positions, prior proposal, best match for every measurement.

        Nothing is exclusive, nothing is clutter and nothing is forgotten (paper, section III-D).
        """
        # All of them, so that no later default changes the preset.
        rules = dict(
            sensor="position",
            association="maximum_likelihood",
            proposal="prior",
            resample_threshold=0.5,
            exclusive=False,
            clutter=False,
            forgetting=False,
            even=False,
            rejuvenate=0.0,
            descriptors=0,
        )
        return cls(
            particles=particles,
            landmarks=landmarks,
            measurements=measurements,
            **(rules | changes),
        )


class Params(NamedTuple):
    """The filter's numbers, each a float or a 0-d array; `UNITS` has their units.

    Motion noise grows with what was driven: variance `err_tran**2` per metre, `err_rot**2` per
    radian turned, `err_drift**2` rad^2 per metre, and the floors per second. Gains are true over
    measured odometry. The bearing's variance is `sigma_bearing**2 + (growth / range)**2`: a tube or
    a door edge has a size. Errors of one landmark's measurements stay alike over a path of
    `correlation`: standing still tells nothing new (0: always independent). `caution` is added to
    the bearing's standard deviation in quadrature by the filter, since its particles are few and
    errors are not as independent as it takes them to be; refinement does without. `view_*` is what
    the sensor can see
    and is declared by the log.
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
    growth: float
    position_scale: float
    correlation: float
    caution: float
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


UNITS = {
    "err_tran": "m/sqrt(m)",
    "err_rot": "rad/sqrt(rad)",
    "err_drift": "rad/sqrt(m)",
    "floor_tran": "m/sqrt(s)",
    "floor_rot": "rad/sqrt(s)",
    "gain_tran": "true / measured",
    "gain_rot": "true / measured",
    "bias_drift": "rad/m",
    "sigma_range": "m",
    "sigma_bearing": "rad",
    "growth": "m",
    "position_scale": "factor",
    "correlation": "m",
    "caution": "rad",
    "mount_x": "m",
    "mount_y": "m",
    "mount_yaw": "rad",
    "outlier": "probability",
    "density_new": "1/m^2",
    "detection": "probability",
    "view_min": "rad",
    "view_max": "rad",
    "view_range": "m",
    "inv_depth_mean": "1/m",
    "inv_depth_sd": "1/m",
    "existence_new": "log-odds",
    "existence_seen": "log-odds per frame",
    "existence_miss": "factor",
    "existence_max": "log-odds",
    "existence_confirm": "log-odds",
}

# Wide enough for a real robot's errors, which are correlated from frame to frame. Tuned by hand on
# the bundled log and MRCLAM dataset 6, with their truth: nothing of these was held out.
_DEFAULTS = Params(
    err_tran=0.02,
    err_rot=0.15,
    err_drift=0.1,
    floor_tran=0.015,
    floor_rot=0.005,
    gain_tran=1.0,
    gain_rot=1.0,
    bias_drift=0.0,
    sigma_range=0.12,
    sigma_bearing=0.05,
    growth=0.12,
    position_scale=1.0,
    correlation=0.0,
    caution=0.0,
    mount_x=0.0,
    mount_y=0.0,
    mount_yaw=0.0,
    outlier=0.01,
    density_new=1e-3,
    detection=0.9,
    view_min=-math.pi,
    view_max=math.pi,
    view_range=10.0,
    inv_depth_mean=0.4,
    inv_depth_sd=0.25,
    existence_new=1.0,
    existence_seen=0.5,
    existence_miss=0.1,
    existence_max=20.0,
    existence_confirm=5.0,
)

# A bearing's noise is the sensor's own, so that refinement can use it as it is; the filter, which
# can't take back a wrong depth, is cautious.
_OF_SENSOR = {
    # Points are made with this motion, too: as tight as it was when they were tried.
    "position": dict(err_tran=0.05, err_rot=0.05, err_drift=0.05, floor_tran=0.002),
    "bearing": dict(sigma_bearing=0.005, growth=0.03, caution=0.06, outlier=3e-3),
}


COMMAND_FLOOR = 0.002  # m/sqrt(s): a commanded step errs with its length, not with time


def default_params(sensor="range_bearing", log=None):
    """Default `Params` of a sensor, with what the log declares: odometry, mounting, view, noise."""
    if sensor not in SENSORS:
        raise ValueError(f"sensor: {sensor!r} is not one of {', '.join(SENSORS)}")
    params = _DEFAULTS._replace(**_OF_SENSOR.get(sensor, {}))
    if log is None:
        return params
    names = ("mount_x", "mount_y", "mount_yaw", "view_min", "view_max", "view_range")
    params = params._replace(**dict(zip(names, (*log.mounting, *log.view), strict=True)))
    if log.odometry_kind == "command":
        params = params._replace(floor_tran=COMMAND_FLOOR)
    return params._replace(**log.noise)
