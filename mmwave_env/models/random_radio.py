"""Random radio profiles for training, so that a policy cannot memorize the noise of one profile."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from mmwave_env.io.records import Record, between
from mmwave_env.models.radio import Radio

# Fields to multiply by random factors. Factors up to 4 keep shipped profiles in Radio's limits.
_SCALED = (
    "aoa_floor_rad", "aod_floor_rad", "elevation_floor_rad", "doppler_floor_mps",
    "prior_position_m", "prior_height_m", "prior_velocity_mps", "prior_bias_mps",
    "shadowing_db", "blockage_scale", "blockage_mean_s", "blockage_range_m", "blockage_angle_rad",
    "multipath_rate_hz", "multipath_mean_s", "multipath_angle_rad", "spread_gain",
    "spread_floor_mps", "drift_mps",
)  # fmt: skip
_PAIRS = ("range_floor_m", "multipath_range_m")  # pairs, each multiplied by one factor


@dataclass(frozen=True)
class RandomRadio(Record):
    """A distribution of radios: a profile with random changes of noise, rates and link budget.

    Attributes:
        profile: profile to change; filters use the modes tuned for it.
        factor: largest factor that a field is multiplied by; the smallest is 1 / factor. Factors
            are log-uniformly distributed between these two.
        budget_db: largest change of the link budget, in either direction.
    """

    profile: Radio
    factor: Annotated[float, between(1.0, 4.0)] = 2.0
    budget_db: Annotated[float, between(0.0, 20.0, "dB")] = 4.0

    def draw(self, rng: np.random.Generator) -> Radio:
        """Draw the next radio."""

        def factor() -> float:
            return float(self.factor ** rng.uniform(-1.0, 1.0))

        values = {name: factor() * getattr(self.profile, name) for name in _SCALED}
        for name in _PAIRS:
            by = factor()
            values[name] = tuple(by * value for value in getattr(self.profile, name))
        budget = self.profile.transmit_dbm + float(rng.uniform(-self.budget_db, self.budget_db))
        return replace(self.profile, transmit_dbm=budget, **values)
