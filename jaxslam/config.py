"""`Config`: the static settings of the filter, which decide shapes and branches.

A value that changes a shape or a branch belongs here; a number, which could be learned, to
`parameters.Params`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

SENSORS = ("range_bearing", "position", "bearing")  # a run takes the first that the log has
ASSOCIATIONS = ("maximum_likelihood", "known", "sampled")
PROPOSALS = ("prior", "informed")
REJUVENATE = 3.0  # m, default for bearings with unknown association
FORMER_FIELDS = {"even": "uniform_association_prior"}  # names of version 0.1, still read from files


@dataclass(frozen=True)
class Config:
    """Static settings of the filter; one compilation per distinct `Config`.

    Model and sizes:

    - `sensor`: one of `SENSORS`.
    - `association`: `known` believes the log's identities; `maximum_likelihood` and `sampled` find
      out which landmark was measured (`filter/association.py`).
    - `proposal`: poses are drawn from odometry (`prior`, FastSLAM 1.0) or from odometry and
      measurements (`informed`, 2.0).
    - `particles` N, `landmarks` M (slots of the map), `measurements` K (per frame, at most).
    - `resample_threshold` t: resample if ESS < t * N (0: never, 1 or more: every frame).
    - `rejuvenate`: metres of driving after which all particles are redrawn from the refined
      posterior (0: never; None: 3 for bearings with unknown association, else never).
    - `descriptors`: coordinates of appearance used for association (0: none).

    Association rules:

    - `exclusive`: two measurements of one frame never match the same landmark.
    - `clutter`: a measurement may be of nothing.
    - `forgetting`: landmarks carry an existence log-odds and are dropped below zero (None: on,
      unless association is known).
    - `uniform_association_prior`: of n landmarks in view each is as likely beforehand to be the one
      measured, so a match counts 1 / n. Without it, a landmark that is twice in the map is twice as
      likely. For `sampled` only.

    Performance, without effect on the result:

    - `block`: particles updated together, so that temporaries stay in cache.
    - `lazy`: resampling does not copy landmarks until they are next used.
    - `chains`: ancestries that `lazy` keeps, at most.
    - `devices`: how many share the particles, evenly.

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

    def __post_init__(self) -> None:
        alone = self.sensor == "bearing" and self.association == "maximum_likelihood"
        if self.rejuvenate is None:
            object.__setattr__(self, "rejuvenate", REJUVENATE if alone else 0.0)
        if self.forgetting is None:
            object.__setattr__(self, "forgetting", self.association != "known")
        for name, allowed in (
            ("sensor", SENSORS), ("association", ASSOCIATIONS), ("proposal", PROPOSALS)
        ):  # fmt: skip
            self._require(name, getattr(self, name) in allowed, f"one of {', '.join(allowed)}")
        sizes = ("particles", "landmarks", "measurements", "block", "chains", "devices")
        for name, least in (*((size, 1) for size in sizes), ("descriptors", 0)):
            whole = self._is_whole(name, least)
            self._require(name, whole, f"a whole number of at least {least}")
        for name, unit in (("resample_threshold", ""), ("rejuvenate", " of metres")):
            value = getattr(self, name)
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            self._require(name, number and 0 <= value < math.inf, f"a number{unit} >= 0")
        for name in ("exclusive", "clutter", "forgetting", "uniform_association_prior", "lazy"):
            self._require(name, isinstance(getattr(self, name), bool), "true or false")
        self._check_combinations()

    def _require(self, name, good, allowed):
        if not good:
            raise ValueError(f"Config.{name}: {getattr(self, name)!r} is not {allowed}")

    def _is_whole(self, name, least):
        value = getattr(self, name)
        return isinstance(value, int) and not isinstance(value, bool) and value >= least

    def _check_combinations(self):
        if self.descriptors and self.association == "known":
            rule = "identities are known, so appearance decides nothing"
            raise ValueError(f"Config.descriptors: {rule}")
        if self.particles % self.devices:
            even = self.particles // self.devices * self.devices
            raise ValueError(
                f"Config.devices: {self.particles} particles are not shared evenly by "
                f"{self.devices}; {even or self.devices} or {even + self.devices} are"
            )
        if self.uniform_association_prior and self.association != "sampled":
            rule = f"is for association sampled, not {self.association}"
            raise ValueError(f"Config.uniform_association_prior: {rule}")

    @property
    def even(self) -> bool:
        """`uniform_association_prior` by its name of version 0.1."""
        return self.uniform_association_prior

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Config":
        """Make a `Config` of a dict as stored in files; names of version 0.1 are read, too."""
        return cls(**{FORMER_FIELDS.get(name, name): value for name, value in values.items()})

    @classmethod
    def paper(
        cls, particles: int = 1000, landmarks: int = 64, measurements: int = 16, **changes: Any
    ) -> "Config":
        """Make the paper's `Config`: 2-D positions, prior proposal, likeliest match for each
        measurement, without exclusion, clutter or forgetting (section III-D).
        """
        # All rules, so that no later default changes the preset.
        rules: dict[str, Any] = dict(
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
