"""Learning a map: localization by paths where only the base station is known.

:mod:`mmwave_env.localization.image_filter` estimates the user and the mirror images of the base
station jointly. This module decides which paths it uses, and which images exist:

1.  *Association.* Paths are assigned to the base station and to all images at once. A pair of an
    anchor and a path is possible if it is likelier than a false path: NIS + ln det S
    < -2 ln(density) - 4 ln(2 pi). So gates are wide while the track is certain, and narrow when it
    is not.
2.  *Update.* The paths of the base station and of confirmed images update everything. The path of a
    tentative image updates only this image, so that a false image cannot move the user.
3.  *Birth.* Any other path that is longer than the line of sight begins a tentative image. Five
    paths in eight epochs confirm it.
4.  *Doubt.* If the track may be wrong, an epoch is processed in several ways (use its paths, ignore
    them, begin anew at one of them), and the coming epochs decide which way is the likeliest.

Beliefs are immutable, so that several ways can be tried side by side.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, islice

import numpy as np
from scipy.special import chdtri

from mmwave_env.filters.modes import Mode
from mmwave_env.io.files import Json
from mmwave_env.localization.association import assign, fix_of, observed
from mmwave_env.localization.image_filter import (
    LINK_ROWS,
    UNKNOWN_RAD,
    USER,
    Belief,
    Doubt,
    Image,
    ImageFilter,
    Paths,
    merged,
    reduced,
)
from mmwave_env.logs.log import PathEpoch, PathLog
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.layout import STATE_SIZE
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import MOST_ANCHORS, LearnedImage, Scene
from mmwave_env.numerics.numbers import PI, Array, Mask

# Density of false paths in each row: range (1 / m), then arrival, elevation, departure (1 / rad).
# An arrival at the image differs from the departure by pi, also if the path is false. An arrival at
# the base station is independent of the departure.
DENSITY = (1.0 / 400.0, 1.0 / (2.0 * PI), 1.0 / 0.22, 1.0 / 0.066)
STATION_DENSITY = 1.0 / (2.0 * PI)  # density of departures in the second case
SIGHT_BONUS = 4.4  # 2 ln(P / (1 - P)), with P = 0.9 to detect the line of sight, else P = 0.5
CONFIRM = 5  # paths that confirm an image
EPOCHS = 8  # in so many epochs
CONFIRM_TAIL = 0.001  # the sum of NIS of a tentative image must not be in this tail
FREE = float(chdtri(LINK_ROWS, 1e-4))  # a path begins an image only if all its NIS are larger
KEEP = 20  # epochs that a confirmed image may be missed, or 4 for each of its paths
TRUSTED = 30  # an image with so many paths survives a new beginning, and belongs to the map
STRAIGHT = 9.0  # NIS of the difference between departure and arrival on a line of sight
LONGER_M = 1.0  # a reflection is longer than the line of sight by at least this length
LOOK_AHEAD = 10  # epochs that decide about a doubtful track
LOST_M = 6.0  # standard deviation of the position from which a track is doubtful
FITS = 0.7  # a lost track uses paths only if it then explains so many paths per coming epoch
CLEARLY = 5.0  # nats by which a new beginning must be likelier
SHORT_PENALTY = 5.0  # nats for an epoch with a path that is shorter than the line of sight
SHORT_SIGMAS = 3.5  # standard deviations by which such a path must be shorter
BEGINNINGS = 4  # number of paths, the shortest ones, at which a track may begin
FEW_EXPLAINED = 0.25  # share of paths below which walls do not describe a place


def trusted(image: Image) -> bool:
    """Return whether an image belongs to the map."""
    return image.exact or (image.confirmed and image.paths >= TRUSTED)


class MapLearner:
    """A tracker of a user and of the images from which paths seem to come.

    Args:
        scene: scene with the base station, and perhaps with known or learned images.
        radio: profile of the receiver; it determines the noise at each SNR, and the prior.
        mode: filter mode whose process noise is used. Choose a mode for high mobility.
    """

    def __init__(self, scene: Scene, radio: Radio, mode: Mode) -> None:
        self._scene = scene
        self._radio = radio
        self._station = np.array(scene.base_station_m)
        self._filter = ImageFilter(self._station, scene.hz_per_mps, mode.tuning)

    def start(self) -> Belief:
        """Return the belief about the scene's images, before a track begins."""
        images = self._scene.anchors_m[1:]
        learned = self._scene.learned
        known = len(images) - len(learned)
        histories = [Image(confirmed=True, exact=True)] * known
        histories += [Image(image.paths, confirmed=True) for image in learned]
        sigma = np.zeros(STATE_SIZE + 3 * len(images))
        sigma[STATE_SIZE + 3 * known :] = np.ravel([image.sigma_m for image in learned])
        x = np.append(np.zeros(STATE_SIZE), images)
        return Belief(x, np.diag(sigma**2), tuple(histories), -np.inf, tracked=False)

    def learn(self, log: PathLog, b: Belief | None = None) -> Iterator[Belief]:
        """Yield the belief after each epoch of a log.

        ``b`` is the belief after an earlier log, whose map the user also meets in this log.
        """
        return self.follow(self.observed(log.epochs, log.at_station), b)

    def observed(self, epochs: Iterable[PathEpoch], at_station: bool) -> Iterator[Paths]:
        """Yield the paths of each epoch of a log as :meth:`follow` needs them."""
        return observed(epochs, at_station, self._scene, self._radio, STRAIGHT)

    def follow(self, epochs: Iterable[Paths], b: Belief | None = None) -> Iterator[Belief]:
        """Yield the belief after each epoch as soon as it is certain; see :meth:`learn`.

        An epoch in which the track is doubtful waits for the next ``LOOK_AHEAD`` epochs, which
        decide about it.
        """
        b = (b or self.start())._replace(tracked=False)
        waiting: deque[Paths] = deque()
        for latest in chain(epochs, [None]):
            if latest is not None:
                waiting.append(latest)
            while waiting:
                paths = waiting[0]
                now_s = paths.time_s
                if not 0.0 < now_s - b.time_s <= GAP_S:  # live, a clock may be set back
                    b = b._replace(tracked=False)
                others = islice(waiting, 1, None)
                coming = [later for later in others if now_s < later.time_s <= now_s + GAP_S]
                decides = len(coming) >= LOOK_AHEAD or len(coming) < len(waiting) - 1
                if latest is not None and not decides and _is_doubtful(b, paths):
                    break
                waiting.popleft()
                b = self._advanced(b, paths, coming[:LOOK_AHEAD])
                yield b

    def _advanced(self, b: Belief, paths: Paths, coming: Sequence[Paths]) -> Belief:
        """Return the belief after an epoch; coming epochs decide what to do if it is doubtful."""
        if b.tracked and not _is_doubtful(b, paths):
            return self._step(b, paths)
        lost = b.tracked and _is_lost(b)
        best = b._replace(time_s=paths.time_s, labels={}, begins=False)
        score = -np.inf
        if b.tracked:
            best, score = self._continued(b, paths, coming, lost)
        shortest = np.argsort(paths.z[:, 0])
        for path in shortest[paths.straight[shortest]][:BEGINNINGS]:
            rival = self._begun(b, paths, int(path))
            likelihood, used = self._follow(rival, coming)
            # A wrong beginning may fit later paths, when its prediction has grown uncertain.
            _, prompt = self._follow(rival, coming[:1])
            fits = used >= len(coming) and prompt >= len(coming[:1])
            if fits and likelihood > score + CLEARLY:
                best = rival
                score = likelihood
        return best

    def _continued(
        self, b: Belief, paths: Paths, coming: Sequence[Paths], lost: bool
    ) -> tuple[Belief, float]:
        """Use or ignore the paths of an epoch; also return the log-likelihood of this decision."""
        using = self._step(b, paths)
        ignoring = self._step(b, paths.part(slice(0)))
        likelihood, used = self._follow(using, coming)
        of_ignoring, _ = self._follow(ignoring, coming)
        if not lost:
            likelihood += using.evidence
        too_few = lost and used < FITS * len(coming)
        if likelihood < of_ignoring or too_few:
            return ignoring, of_ignoring
        return using, likelihood

    def _follow(self, b: Belief, coming: Iterable[Paths]) -> tuple[float, int]:
        """Return the evidence and the number of used paths in coming epochs."""
        evidence = 0.0
        used = 0
        for paths in coming:
            b = self._step(b, paths)
            evidence += b.evidence
            used += len(b.labels)
        return evidence, used

    def _begun(self, b: Belief, paths: Paths, path: int) -> Belief:
        """Return a track that begins at a path as line of sight, and keeps the map."""
        prior = fix_of(paths, path, self._radio, self._scene)
        b = reduced(b, [trusted(image) for image in b.images])
        x = b.x.copy()
        P = b.P.copy()
        P[:STATE_SIZE] = 0.0
        P[:, :STATE_SIZE] = 0.0
        x[:STATE_SIZE], P[:STATE_SIZE, :STATE_SIZE] = prior
        others = np.arange(len(paths)) != path
        begun = Belief(x, P, b.images, paths.time_s)
        begun = self._step(begun, paths.part(others), sight_used=True)
        rest = np.flatnonzero(others)
        labels = {anchor: int(rest[i]) for anchor, i in begun.labels.items()}
        return begun._replace(labels={**labels, 0: path}, begins=True)

    def _step(self, b: Belief, paths: Paths, sight_used: bool = False) -> Belief:
        """Return the belief after an epoch.

        With ``sight_used``, the base station's path was used before, and is not among the paths.
        """
        b = self._filter.predicted(b, paths.time_s)
        if not len(paths):
            return _aged(b, {}, {})
        labels, nis, evidence = self._assign(b, paths)
        used = {a: i for a, i in labels.items() if a == 0 or b.images[a - 1].confirmed}
        b = self._filter.updated(b, paths, used, nis)
        short = bool(self._shorter(b, paths).any())
        # Also count paths of tentative images: a new track has no others besides the line of sight.
        likelihood = sum(evidence[a, i] for a, i in labels.items()) - SHORT_PENALTY * short
        b = b._replace(labels=used, evidence=float(likelihood))
        of_tentative = {}
        for anchor, path in labels.items():
            if anchor not in used:
                b = self._filter.image_updated(b, paths, anchor, path)
                of_tentative[anchor] = float(nis[anchor, path])
        for path in self._unexplained(b, paths, labels):
            b = self._filter.with_image(b, paths, path)
            labels[len(b.images)] = path
        doubt = Doubt(
            unused=0 if used else b.doubt.unused + 1,
            blind=0 if sight_used or 0 in used else b.doubt.blind + 1,
            short=b.doubt.short + 1 if short else 0,
        )
        return _aged(b._replace(doubt=doubt), labels, of_tentative)

    def _assign(self, b: Belief, paths: Paths) -> tuple[dict[int, int], Array, Array]:
        """Return the path of each anchor that has one; NIS (A, n); and evidence (A, n), in nats.

        The assignment is a global nearest neighbor (Blackman and Popoli 1999, Sec. 6.4).
        """
        nis, log_det = self._filter.nis(b, paths)
        density = [*DENSITY[:3], STATION_DENSITY if paths.at_station else DENSITY[3]]
        unknown = paths.direct >= UNKNOWN_RAD**2  # these rows must not make a path likelier
        log_density = np.where(unknown, -0.5 * np.log(2.0 * PI * paths.direct), np.log(density))
        limit = -2.0 * log_density.sum(axis=1) - LINK_ROWS * np.log(2.0 * PI)
        cost = nis + log_det - limit
        evidence = -0.5 * cost
        cost[0] -= SIGHT_BONUS
        possible = np.flatnonzero(cost[0] < 0.0)
        if len(possible):  # of the paths that may be the line of sight, only the shortest may
            length = paths.z[possible, 0]
            variance = paths.direct[possible, 0]
            shortest = length.argmin()
            apart = 3.0 * np.sqrt(variance + variance[shortest])
            cost[0, possible[length > length[shortest] + apart]] = 0.0
        return assign(cost, 0.0), nis, evidence

    def _shorter(self, b: Belief, paths: Paths) -> Mask:
        """Tell which paths (n,) are shorter than the line of sight, which is impossible."""
        d = b.x[USER] - self._station
        distance = np.linalg.norm(d)
        u = d / distance
        sigma = np.sqrt(u @ b.P[USER, USER] @ u + paths.direct[:, 0])
        shorter = paths.z[:, 0] < distance - SHORT_SIGMAS * sigma - LONGER_M
        return paths.straight & shorter  # type: ignore[no-any-return]

    def _unexplained(self, b: Belief, paths: Paths, labels: Mapping[int, int]) -> list[int]:
        """Return the paths that may come from images that are still unknown."""
        nis, _ = self._filter.nis(b, paths)
        longer = paths.z[:, 0] > np.linalg.norm(b.x[USER] - self._station) + LONGER_M
        free = np.flatnonzero(longer & (nis.min(axis=0) > FREE)).tolist()
        return [path for path in free if path not in labels.values()]


def _is_doubtful(b: Belief, paths: Paths) -> bool:
    """Return whether coming epochs must decide what to do with the paths of an epoch."""
    blind = b.doubt.blind >= 3 and b.doubt.blind % 5 == 3
    wrong = blind or b.doubt.unused >= 2 or b.doubt.short >= 2
    return len(paths) > 0 and (not b.tracked or wrong or _is_lost(b))


def _is_lost(b: Belief) -> bool:
    """Return whether the position of a track is hardly known."""
    return bool(np.linalg.eigvalsh(b.P[:2, :2])[-1] > LOST_M**2)


def _aged(b: Belief, labels: Mapping[int, int], of_tentative: Mapping[int, float]) -> Belief:
    """Return the belief with images confirmed, removed and merged.

    ``labels`` are the paths of all images in this epoch; ``of_tentative`` are NIS.
    """
    images = []
    for anchor, image in enumerate(b.images, start=1):
        hit = anchor in labels
        images.append(
            _judged(
                image._replace(
                    paths=image.paths + hit,
                    recent=(*image.recent, hit)[-EPOCHS:],
                    missed=0 if hit else image.missed + 1,
                    nis=image.nis + of_tentative.get(anchor, 0.0),
                )
            )
        )
    keep = [image is not None for image in images]
    b = b._replace(images=tuple(image or Image() for image in images))
    return merged(reduced(b, keep))


def _judged(image: Image) -> Image | None:
    """Return the image, perhaps confirmed; None if it is to be removed."""
    if image.exact:
        return image
    if image.confirmed:
        return image if image.missed <= KEEP * max(1.0, image.paths / CONFIRM) else None
    if sum(image.recent) >= CONFIRM:
        fits = image.nis < chdtri(LINK_ROWS * (image.paths - 1), CONFIRM_TAIL)
        return image._replace(confirmed=True) if fits else None
    hopeless = image.missed > EPOCHS - CONFIRM or len(image.recent) >= EPOCHS
    return None if hopeless else image


def learn_map(
    logs: Sequence[PathLog], scene: Scene, radio: Radio, mode: Mode
) -> tuple[Scene, Json]:
    """Learn the images that several logs reveal, in order; see :class:`MapLearner`.

    Returns:
        The scene with the learned images as virtual anchors, for any log; and figures: the counts
        of epochs, of paths, of paths that they explain and of starts of tracks; and each image.

    Raises:
        LogError: no track begins in one of the logs.
    """
    learner = MapLearner(scene, radio, mode)
    belief = learner.start()
    counts = {"epochs": 0, "paths": 0, "explained": 0, "starts": 0}
    for number, log in enumerate(logs, start=1):
        before = counts["starts"]
        beliefs = learner.learn(log, belief)
        for epoch in log.epochs:
            belief = next(beliefs)
            counts["epochs"] += 1
            counts["paths"] += len(epoch.snr_db)
            counts["explained"] += len(belief.labels)
            counts["starts"] += belief.begins
        if counts["starts"] == before:
            raise LogError(
                f"log {number} of {len(logs)}: found no path with which a track can begin, "
                "expected an epoch with a line of sight (arrival and departure are opposite) whose "
                "position explains a path in each of the next epochs"
            )
    scene = learned_scene(scene, belief)
    return scene, {**counts, "images": _images(scene)}


def learned_scene(scene: Scene, belief: Belief) -> Scene:
    """Return the scene with the learned images as virtual anchors.

    If there are too many for a scene, those with the most paths are kept.
    """
    images = belief.images
    exact = sum(image.exact for image in images)
    of_map = [k for k, image in enumerate(images) if trusted(image) and not image.exact]
    of_map.sort(key=lambda k: images[k].paths, reverse=True)
    kept = sorted(of_map[: MOST_ANCHORS - 1 - exact])
    sigma = np.sqrt(np.diag(belief.P)[STATE_SIZE:]).reshape(-1, 3)
    surveyed = scene.virtual_anchors_m[: len(scene.virtual_anchors_m) - len(scene.learned)]

    def of_images(values: tuple[float, ...]) -> tuple[float, ...]:
        """Give the images the value of their base station."""
        return (*values[: 1 + exact], *values[:1] * len(kept))

    return replace(
        scene,
        virtual_anchors_m=(*surveyed, *(_point(belief.places[k]) for k in kept)),
        range_offset_m=of_images(scene.range_offset_m),
        range_offset_sigma_m=of_images(scene.range_offset_sigma_m),
        learned=tuple(LearnedImage(_point(sigma[k]), images[k].paths) for k in kept),
    )


def _point(coordinates: Array) -> tuple[float, float, float]:
    x, y, z = coordinates.tolist()
    return x, y, z


def _images(scene: Scene) -> list[Json]:
    """Return figures about each learned image of a scene, with the wall that makes it.

    The wall of an image a is halfway between a and the base station g, with the normal a - g.
    """
    station = np.array(scene.base_station_m)
    images = []
    first = len(scene.anchors_m) - len(scene.learned)
    learned = zip(scene.anchors_m[first:], scene.learned, strict=True)
    for number, (place, image) in enumerate(learned, start=first + 1):
        normal = (place - station)[:2]
        normal = normal / np.linalg.norm(normal)
        offset_m = float(normal @ (place + station)[:2] / 2.0)
        images.append(
            {
                "anchor": number,
                "position_m": place.tolist(),
                "sigma_m": list(image.sigma_m),
                "paths": image.paths,
                "wall": {"normal": normal.tolist(), "offset_m": offset_m},
            }
        )
    return images
