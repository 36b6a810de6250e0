"""What a run is told: `Config` (static, decides shapes and branches) and `Params` (numbers).

A value that changes a shape or a branch belongs to `Config`; one that changes a number, and could
be learnt, to `Params`.
"""

import math
from dataclasses import dataclass

SENSORS = ("range_bearing", "position", "bearing")  # a run takes the first that the log has
ASSOCIATIONS = ("maximum_likelihood", "known", "sampled")
PROPOSALS = ("prior", "informed")
REJUVENATE = 3.0  # m
FORMER_FIELDS = {"even": "uniform_association_prior"}  # names of version 0.1, in files


@dataclass(frozen=True)
class Config:
    """Static settings of the filter; one compilation per distinct `Config`.

    `proposal`: poses are drawn from the motion alone (`prior`, FastSLAM 1.0) or from motion times
    measurements (`informed`, 2.0). `association`: see `association`.
    `resample_threshold` t: resample when ESS < t * particles (0: never, 1 or more: every frame).
    `exclusive`: two measurements of one frame never share a landmark. `clutter`: a measurement may
    come from nothing. `forgetting`: landmarks carry an existence log-odds and are freed below zero
    (None: on, unless identities are known). `uniform_association_prior`: of n landmarks in view each is as likely
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
    uniform_association_prior: bool = False
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
        for name in ("exclusive", "clutter", "forgetting", "uniform_association_prior", "lazy"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"Config.{name}: {getattr(self, name)!r} is not true or false")

        if self.uniform_association_prior and self.association != "sampled":
            raise ValueError(
                f"Config.uniform_association_prior: is for association sampled, not {self.association}"
            )

    @classmethod
    def from_dict(cls, values):
        """A `Config` of a dict as files hold it; names of version 0.1 are understood."""
        return cls(**{FORMER_FIELDS.get(name, name): value for name, value in values.items()})

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
            uniform_association_prior=False,
            rejuvenate=0.0,
            descriptors=0,
        )
        return cls(
            particles=particles,
            landmarks=landmarks,
            measurements=measurements,
            **(rules | changes),
        )
