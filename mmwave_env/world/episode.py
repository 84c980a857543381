"""Episodes: arrays with the truth, the measurements and the noise of all epochs.

No action of an agent changes these data, so they can be complete before the first step. They are
simulated or recorded.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np

from mmwave_env.io.records import FINITE, Bound
from mmwave_env.models import envelope
from mmwave_env.models.layout import Layout, offered_rows, whole_groups
from mmwave_env.models.measurement import Epoch, Site, blank_site
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Index, Mask, Number, Numbers, Vector, where
from mmwave_env.numerics.pytree import flatten, indices

NEUTRAL_SNR_DB = 20.0  # replaces an SNR that was not measured; about the mean SNR in streets


def require_increasing(record: str, time_s: Array) -> None:
    """Refuse the times (T,) of epochs of an episode or a track unless they increase."""
    if len(time_s) < 1 or not (np.diff(time_s) > 0.0).all():
        raise ValueError(
            f"time_s of {record}: found times that do not increase, expected one or more "
            "increasing times"
        )


@dataclass(frozen=True, eq=False)
class Episode:
    """The data of T epochs of one user.

    A group is the rows of a link, of the Doppler shift or of odometry. Where ``visible`` is False,
    the group is missing and its values are meaningless. Values that are NaN or infinite count as
    missing. In a partial layout, single rows of a group may be missing: these rows are NaN, and the
    group is visible if at least one row was measured. Values that the filters cannot handle are
    refused (:mod:`~mmwave_env.models.envelope`).

    Attributes:
        name: name of the episode, for results and messages.
        scene_anchors_m: (L, 3) anchors, the physical gNB first.
        hz_per_mps: carrier frequency divided by the speed of light.
        time_s: (T,) increasing times.
        measurement: (T, rows) values in the order of ``layout``: m, rad, Hz, m/s.
        sigma: (T, rows) standard deviations in the same units, positive.
        visible: (T, groups) whether the group was measured.
        snr_db: (T, L) SNR of each link.
        doppler_spread_hz: (T,) measured Doppler spread; 0 where none was measured.
        prior_mean: (7,) mean of the state at the first epoch; (8,) with a clock offset.
        prior_covariance: (7, 7) positive definite covariance; (8, 8) with a clock offset.
        layout: which quantity is in which row, and which rows form a group.
        truth_position_m: (T, 3) true positions; None if unknown.
        truth_velocity_mps: (T, 3) true velocities; None if unknown.
        doppler_anchor: (T,) index, from 0, of the anchor whose Doppler shift was measured (used
            only in a partial layout); None if it is the first anchor in every epoch.
    """

    name: str
    scene_anchors_m: Array
    hz_per_mps: float
    time_s: Array
    measurement: Array
    sigma: Array
    visible: Mask
    snr_db: Array
    doppler_spread_hz: Array
    prior_mean: Array
    prior_covariance: Array
    layout: Layout
    truth_position_m: Array | None = None
    truth_velocity_mps: Array | None = None
    doppler_anchor: Index | None = None

    def __post_init__(self) -> None:
        self._require_shapes()
        if not (self.sigma > 0.0).all():
            wrong = self.sigma[~(self.sigma > 0.0)][0]
            raise ValueError(f"sigma of {self._record}: found {wrong}, expected > 0 everywhere")
        P = self.prior_covariance
        if not (abs(P - P.T).max() <= 1e-8 * abs(P).max() and np.linalg.eigvalsh(P)[0] > 0.0):
            raise ValueError(
                f"prior_covariance of {self._record}: found {P.tolist()}, expected a positive "
                "definite matrix"
            )
        for field, values, bound in self._bounded():
            wrong = ~bound.holds(values)
            if wrong.any():
                raise ValueError(
                    f"{field} of {self._record}: found {values[wrong].flat[0]:g}, expected "
                    f"{bound.expected}"
                )

    def _require_shapes(self) -> None:
        """Refuse arrays of wrong shapes, and times that do not increase."""
        T = len(self.time_s)
        layout = self.layout
        shapes = {
            "measurement": (T, layout.size),
            "visible": (T, len(layout.groups)),
            "scene_anchors_m": (layout.anchors, 3),
            "sigma": (T, layout.size),
            "snr_db": (T, layout.anchors),
            "doppler_spread_hz": (T,),
            "prior_mean": (layout.state_size,),
            "prior_covariance": (layout.state_size, layout.state_size),
            "truth_position_m": (T, 3),
            "truth_velocity_mps": (T, 3),
            "doppler_anchor": (T,),
        }
        for field, shape in shapes.items():
            value = getattr(self, field)
            if value is not None and value.shape != shape:
                raise ValueError(
                    f"{field} of {self._record}: found shape {value.shape}, expected shape {shape}"
                )
        require_increasing(self._record, self.time_s)

    def _bounded(self) -> Iterator[tuple[str, Array, Bound]]:
        """Yield the name, the values and the bound of each quantity that has a bound."""
        mean = self.prior_mean
        deviation = np.sqrt(np.diag(self.prior_covariance))
        used = self.used
        if self.truth_position_m is not None and self.truth_velocity_mps is not None:
            yield "truth_position_m", self.truth_position_m, FINITE
            yield "truth_velocity_mps", self.truth_velocity_mps, FINITE
        yield "hz_per_mps", np.array([self.hz_per_mps]), envelope.HZ_PER_MPS
        yield "time_s, step", np.diff(self.time_s), envelope.STEP_S
        yield "doppler_spread_hz", self.doppler_spread_hz, envelope.DOPPLER_SPREAD_HZ
        yield "scene_anchors_m", self.scene_anchors_m, envelope.POSITION_M
        yield "prior_mean, position", mean[:3], envelope.POSITION_M
        yield "prior_mean, velocity", mean[3:6], envelope.VELOCITY_MPS
        yield "prior_mean, bias", mean[6:7], envelope.BIAS_HZ
        yield "prior_mean, clock", mean[7:], envelope.POSITION_M
        yield "prior_covariance, position", deviation[:3], envelope.POSITION_SIGMA_M
        yield "prior_covariance, velocity", deviation[3:6], envelope.VELOCITY_SIGMA_MPS
        yield "prior_covariance, bias", deviation[6:7], envelope.BIAS_SIGMA_HZ
        yield "prior_covariance, clock", deviation[7:], envelope.POSITION_SIGMA_M
        layout = self.layout
        lengths = np.setdiff1d(np.arange(layout.size), [*layout.angles, layout.doppler]).tolist()
        for rows, bound in (
            (lengths, envelope.RANGE_SIGMA_M),  # and speed
            (layout.angles, envelope.ANGLE_SIGMA_RAD),
            ([layout.doppler], envelope.DOPPLER_SIGMA_HZ),
        ):
            yield "sigma", self.sigma[:, rows][used[:, rows]], bound

    @classmethod
    def measured(
        cls,
        scene: Scene,
        radio: Radio,
        layout: Layout,
        snr_db: Array,
        sigma: Array | None = None,
        doppler_anchor: Index | None = None,
        **others: Any,
    ) -> "Episode":
        """Return an episode of measured arrays.

        Arguments that are not listed here are attributes of the episode.

        Args:
            scene, radio: scene that contains the anchors, and profile of the receiver.
            sigma: (T, rows) standard deviations that the receiver reports. The radio profile
                computes those that are NaN (all of them, if sigma is None) from the SNR.
            others: the remaining attributes.
        """
        known = np.isfinite(snr_db)
        stated = radio.sigma(snr_db, scene, layout)
        if layout.partial:
            snr_db = np.where(known, snr_db, NEUTRAL_SNR_DB)  # observations must be finite
            if doppler_anchor is not None:
                own = np.take_along_axis(snr_db, doppler_anchor[:, None], axis=1)
                of_doppler = radio.sigma(np.repeat(own, layout.anchors, axis=1), scene, layout)
                stated[:, layout.doppler] = of_doppler[:, layout.doppler]
        if sigma is not None:
            stated = np.where(np.isfinite(sigma), sigma, stated)
        return cls(
            scene_anchors_m=scene.anchors_m,
            hz_per_mps=scene.hz_per_mps,
            layout=layout,
            snr_db=snr_db,
            sigma=stated,
            doppler_anchor=doppler_anchor,
            **others,
        )

    @property
    def _record(self) -> str:
        return f"episode {self.name!r}"

    def __len__(self) -> int:
        return len(self.time_s)

    @cached_property
    def usable(self) -> Mask:
        """Return a mask (T, groups) of groups that are visible and whole, with finite values.

        :func:`~mmwave_env.models.layout.whole_groups` says when a group is whole.
        """
        return self.visible & whole_groups(self._finite, np.isfinite(self.snr_db), self.layout)

    @property
    def _finite(self) -> Mask:
        return np.isfinite(self.measurement) & np.isfinite(self.sigma)

    @property
    def used(self) -> Mask:
        """Return a mask (T, rows) of measured rows in usable groups."""
        groups = np.repeat(self.usable, self.layout.widths, axis=1)
        return groups & self._finite if self.layout.partial else groups

    @property
    def nonfinite(self) -> int:
        """Return the number of visible groups with NaN or infinity, which count as missing."""
        return int((self.visible & ~self.usable).sum())

    def require_truth(self) -> None:
        """Refuse an episode that cannot be scored, because its true positions are unknown."""
        if self.truth_position_m is None or self.truth_velocity_mps is None:
            raise ValueError(f"{self._record}: found no truth, which reward and metrics need")

    def only(self, measurements: Sequence[str]) -> "Episode":
        """Return the episode with only these measurements, e.g. "range", in a partial layout."""
        layout = replace(self.layout, partial=True)
        rows = self.used & offered_rows(layout, measurements)
        measurement = np.where(rows, self.measurement, np.nan)
        visible = whole_groups(rows, self.visible, layout)
        return replace(self, measurement=measurement, visible=visible, layout=layout)

    def table(self) -> Array:
        """Return the table (T, columns) that engines load; :func:`columns_of` gives the columns."""
        at = columns_of(self.layout)
        links = self.usable[:, : self.layout.anchors]
        keep = self.used
        position = self.truth_position_m
        velocity = self.truth_velocity_mps
        table = np.empty((len(self), len(flatten(at))))
        table[:, at.dt] = np.diff(self.time_s, prepend=self.time_s[0])
        table[:, at.z] = np.where(keep, self.measurement, 0.0)
        table[:, at.signed_sigma] = np.where(keep, self.sigma, -1.0)
        table[:, at.snr_db] = np.where(links, self.snr_db, 0.0)
        if self.layout.partial:
            anchor = 0 if self.doppler_anchor is None else self.doppler_anchor
            table[:, at.doppler_of] = np.eye(self.layout.anchors)[anchor]
        table[:, at.doppler_spread_hz] = self.doppler_spread_hz
        table[:, at.truth[:3]] = np.nan if position is None else position
        table[:, at.truth[3:]] = np.nan if velocity is None else velocity
        return table

    def site(self) -> Array:
        """Return anchors, carrier and prior as one array (numbers,), which engines load."""
        packed = self.prior_covariance[np.tril_indices(self.layout.state_size)]
        site = Site(self.scene_anchors_m.tolist(), self.hz_per_mps, [*self.prior_mean], [*packed])
        return np.array(flatten(site))


class EpisodeBatch(NamedTuple):
    """A batch of n episodes in the form that engines load."""

    names: list[str]  # (n,) names of the episodes
    length: Index  # (n,) number of epochs
    table: Array  # (n, epochs, columns) from :meth:`Episode.table`; unused after the last epoch
    site: Array  # (n, numbers) anchors, carrier and prior from :meth:`Episode.site`
    layout: Layout  # layout of all episodes

    @classmethod
    def of(
        cls, episodes: "EpisodeBatch | Sequence[Episode]", layout: Layout | None = None
    ) -> "EpisodeBatch":
        """Return a batch of episodes.

        Raises:
            ValueError: a layout differs from ``layout`` (if None: from the first episode's layout).
        """
        if isinstance(episodes, EpisodeBatch):
            return episodes
        layout = layout or episodes[0].layout
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
            length=length,
            table=table,
            site=np.stack([episode.site() for episode in episodes]),
            layout=layout,
        )


class Incoming(NamedTuple):
    """An epoch in :meth:`Episode.table`; fields without comments are the same as in ``Epoch``."""

    dt: Number
    z: Numbers
    signed_sigma: Numbers  # (rows,) standard deviations; negative if the row is missing
    snr_db: Numbers
    doppler_spread_hz: Number
    truth: Numbers  # (6,) true position (m) and velocity (m/s), to compute scores
    doppler_of: Vector

    def epoch(self, layout: Layout) -> Epoch:
        """Return everything except the truth, which the estimator must not use."""
        sigma = [abs(sigma) for sigma in self.signed_sigma]
        measured = [where(sigma > 0.0, 1.0, 0.0) for sigma in self.signed_sigma]
        if layout.partial:
            visible = [where(number > 0.5, 1.0, 0.0) for number in layout.degrees(measured)]
        else:
            visible = [measured[rows.start] for rows in layout.groups]
            measured = []
        snr_db = self.snr_db
        spread_hz = self.doppler_spread_hz
        return Epoch(self.dt, self.z, sigma, visible, snr_db, spread_hz, measured, self.doppler_of)


def blank_incoming(layout: Layout) -> Incoming:
    """Return an epoch without measurements."""
    L = layout.anchors
    nothing = [0.0] * layout.size
    doppler_of = [float(a == 0) for a in range(L)] if layout.partial else ()
    return Incoming(0.0, nothing, [-1.0] * layout.size, [0.0] * L, 0.0, [0.0] * 6, doppler_of)


@lru_cache(maxsize=64)
def columns_of(layout: Layout) -> Any:
    """Return an :class:`Incoming` that holds, for each value, its column in the table."""
    return indices(blank_incoming(layout))


def site_index(layout: Layout) -> Site:
    """Return a :class:`Site` that holds the index of each number in :meth:`Episode.site`."""
    return indices(blank_site(layout))


class EpisodeSource(Protocol):
    """The interface of a source of episodes.

    Attributes:
        layout: layout of every episode's measurements.
        epochs: number of epochs of every episode.
        name: name of the source, for results.
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
