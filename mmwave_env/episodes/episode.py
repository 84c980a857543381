"""An episode: everything that happens, complete before the first step.

Nothing an agent does changes truth, measurements or noise, so an episode is data: arrays
over epochs, drawn from a simulation or taken from a recording. Everything downstream treats
both alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mmwave_env.models.measurement import Layout

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Episode:
    """T epochs of one user.

    Missing groups are a mask, never a magic value: where ``visible`` is False the numbers
    mean nothing. Measurements that are NaN or infinite are marked missing and counted.

    Attributes:
        name: what it is, for results and messages.
        scene_anchors_m: (L, 3) anchors, the physical gNB first.
        hz_per_mps: carrier frequency over the speed of light.
        time_s: (T,) increasing.
        measurement: (T, rows) in the order of ``layout``: m, rad, Hz, m/s.
        sigma: (T, rows) standard deviations, same units, positive.
        visible: (T, groups) bool.
        snr_db: (T, L).
        doppler_spread_hz: (T,).
        prior_mean: (7,) state at the first epoch.
        prior_covariance: (7, 7), positive definite.
        truth_position_m: (T, 3), or None where nobody knows.
        truth_velocity_mps: (T, 3), or None.
        layout: rows and groups.
    """

    name: str
    scene_anchors_m: Array
    hz_per_mps: float
    time_s: Array
    measurement: Array
    sigma: Array
    visible: NDArray[np.bool_]
    snr_db: Array
    doppler_spread_hz: Array
    prior_mean: Array
    prior_covariance: Array
    truth_position_m: Array | None
    truth_velocity_mps: Array | None
    layout: Layout

    def __post_init__(self) -> None:
        T, layout = len(self.time_s), self.layout
        groups = len(layout.groups)
        shapes: dict[str, tuple[int, ...]] = {
            "scene_anchors_m": (layout.anchors, 3), "time_s": (T,),
            "measurement": (T, layout.size), "sigma": (T, layout.size), "visible": (T, groups),
            "snr_db": (T, layout.anchors), "doppler_spread_hz": (T,), "prior_mean": (7,),
            "prior_covariance": (7, 7), "truth_position_m": (T, 3), "truth_velocity_mps": (T, 3),
        }  # fmt: skip
        for field, shape in shapes.items():
            value = getattr(self, field)
            if value is not None and value.shape != shape:
                self._refuse(field, f"shape {value.shape}", f"shape {shape}")
        if T < 1 or not (np.diff(self.time_s) > 0.0).all():
            self._refuse("time_s", "times that do not increase", "at least one, increasing")
        if not 0.0 < self.hz_per_mps < np.inf:
            self._refuse("hz_per_mps", f"{self.hz_per_mps}", "> 0")
        if not (self.sigma > 0.0).all():
            wrong = self.sigma[~(self.sigma > 0.0)]
            self._refuse("sigma", f"{wrong[0]}", "> 0 everywhere")
        for field in (
            "scene_anchors_m", "doppler_spread_hz", "prior_mean", "truth_position_m",
            "truth_velocity_mps",
        ):  # fmt: skip
            value = getattr(self, field)
            if value is not None and not np.isfinite(value).all():
                self._refuse(field, "NaN or infinity", "finite numbers")
        P = self.prior_covariance
        if not (abs(P - P.T).max() <= 1e-8 * abs(P).max() and np.linalg.eigvalsh(P)[0] > 0.0):
            self._refuse("prior_covariance", f"{P.tolist()}", "a positive definite matrix")

    def _refuse(self, field: str, found: str, expected: str) -> None:
        raise ValueError(f"{field} of episode {self.name!r}: found {found}, expected {expected}")

    def __len__(self) -> int:
        return len(self.time_s)

    @cached_property
    def usable(self) -> NDArray[np.bool_]:
        """(T, groups) visible, and every number of the group finite."""
        finite = np.isfinite(self.measurement) & np.isfinite(self.sigma)
        for link in range(self.layout.anchors):
            finite[:, self.layout.link(link)] &= np.isfinite(self.snr_db[:, link, None])
        starts = [rows.start for rows in self.layout.groups]
        usable: NDArray[np.bool_] = self.visible & np.logical_and.reduceat(finite, starts, axis=1)
        return usable

    @property
    def nonfinite(self) -> int:
        """Groups marked visible whose numbers are NaN or infinite; they count as missing."""
        return int((self.visible & ~self.usable).sum())

    @property
    def has_truth(self) -> bool:
        """Whether errors, rewards and metrics can be computed."""
        return self.truth_position_m is not None and self.truth_velocity_mps is not None

    def require_truth(self) -> None:
        """Refuse an episode that can't be scored.

        Raises:
            ValueError: position or velocity is not known.
        """
        if not self.has_truth:
            raise ValueError(
                f"episode {self.name!r}: found no truth, which reward and metrics need"
            )

    def on_flat_ground(self, height_m: float) -> "Episode":
        """The same episode with the height known: z is that of the ground, vz is 0."""
        mean = self.prior_mean.copy()
        mean[2], mean[5] = height_m, 0.0
        return replace(self, prior_mean=mean)

    def table(self) -> Array:
        """(T, columns) as the engine loads it.

        Columns: dt, rows, standard deviations (negative where the group is missing), SNR,
        Doppler spread, true position and velocity.
        """
        links = self.usable[:, : self.layout.anchors]
        keep = np.repeat(self.usable, [r.stop - r.start for r in self.layout.groups], axis=1)
        unknown = np.full((len(self), 3), np.nan)
        position, velocity = self.truth_position_m, self.truth_velocity_mps
        return np.column_stack(
            [
                np.diff(self.time_s, prepend=self.time_s[0]),
                np.where(keep, self.measurement, 0.0),
                np.where(keep, self.sigma, -1.0),
                np.where(links, self.snr_db, 0.0),
                self.doppler_spread_hz,
                unknown if position is None else position,
                unknown if velocity is None else velocity,
            ]
        )

    def site(self) -> Array:
        """Anchors, carrier and packed prior as one row of numbers, as the engine loads it."""
        packed = self.prior_covariance[np.tril_indices(7)]
        return np.concatenate(
            [self.scene_anchors_m.ravel(), [self.hz_per_mps], self.prior_mean, packed]
        )


class Packed(NamedTuple):
    """Many episodes as an engine loads them.

    Attributes:
        names: (n,) of the episodes.
        nonfinite: (n,) as in :class:`Episode`.
        length: (n,) epochs.
        table: (n, epochs, columns), rows of :meth:`Episode.table` up to the length.
        site: (n, numbers), rows of :meth:`Episode.site`.
        layout: of all of them.
    """

    names: list[str]
    nonfinite: Index
    length: Index
    table: Array
    site: Array
    layout: Layout

    @classmethod
    def of(cls, episodes: Sequence[Episode]) -> "Packed":
        """The same episodes.

        Raises:
            ValueError: their layouts differ.
        """
        layout = episodes[0].layout
        for episode in episodes:
            if episode.layout != layout:
                raise ValueError(
                    f"layout of episode {episode.name!r}: found {episode.layout}, expected {layout}"
                )
        tables = [episode.table() for episode in episodes]
        length = np.array([len(table) for table in tables])
        table = np.empty((len(tables), length.max(), tables[0].shape[1]))
        for row, own in zip(table, tables, strict=True):
            row[: len(own)] = own
        return cls(
            names=[episode.name for episode in episodes],
            nonfinite=np.array([episode.nonfinite for episode in episodes]),
            length=length,
            table=table,
            site=np.stack([episode.site() for episode in episodes]),
            layout=layout,
        )

    def on_flat_ground(self) -> "Packed":
        """The same with the height known, as :meth:`Episode.on_flat_ground` at the first epoch."""
        site, mean = self.site.copy(), 3 * self.layout.anchors + 1
        site[:, mean + 2] = self.table[:, 0, -4]  # z of the truth, whose columns are the last six
        site[:, mean + 5] = 0.0
        return self._replace(site=site)


class EpisodeSource(Protocol):
    """Where episodes come from.

    Attributes:
        layout: rows of every episode's measurements.
        epochs: length of every episode.
        name: for results.
    """

    @property
    def layout(self) -> Layout: ...  # noqa: D102
    @property
    def epochs(self) -> int: ...  # noqa: D102
    @property
    def name(self) -> str: ...  # noqa: D102

    def sample(self, rng: np.random.Generator) -> Episode:
        """Draw one episode; all randomness comes from ``rng``."""
        ...
