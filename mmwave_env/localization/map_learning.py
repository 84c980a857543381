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
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from scipy.special import chdtri

from mmwave_env.filters.modes import Mode
from mmwave_env.io.files import Json
from mmwave_env.localization.association import assign
from mmwave_env.localization.image_filter import (
    LINK_ROWS,
    UNKNOWN_RAD,
    USER,
    Belief,
    Doubt,
    Image,
    ImageFilter,
    Paths,
    block,
    merged,
    reduced,
)
from mmwave_env.logs.log import PathLog
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
LONGER_M = 1.0  # a reflection is longer than the line of sight by at least this length
LOOK_AHEAD = 10  # epochs that decide about a doubtful track
LOST_M = 6.0  # standard deviation of the position from which a track is doubtful
# A lost track uses paths, and a new one begins, only if it then explains so many paths per coming
# epoch. Not every epoch has a line of sight, so a new track need not explain one in each.
FITS = 0.7
CLEARLY = 5.0  # nats by which a new beginning must be likelier
SHORT_PENALTY = 5.0  # nats for an epoch with a path that is shorter than the line of sight
SHORT_SIGMAS = 3.5  # standard deviations by which such a path must be shorter
BEGINNINGS = 4  # number of paths, the shortest ones, at which a track may begin
SAME_M = 10.0  # distance within which an image is the one that an earlier log revealed
MOVED_SIGMAS = 5.0  # standard deviations by which it then must not have moved
FEW_EXPLAINED = 0.25  # share of paths below which walls do not describe a place


def trusted(image: Image) -> bool:
    """Return whether an image belongs to the map."""
    return image.exact or (image.confirmed and image.paths >= TRUSTED)


class MapLearner(ImageFilter):
    """A tracker of a user and of the images from which paths seem to come."""

    straight = 9.0

    def follow(self, epochs: Iterable[Paths], b: Belief | None = None) -> Iterator[Belief]:
        """Yield the belief after each epoch of a log as soon as it is certain.

        ``b`` is the belief after an earlier log, whose map the user also meets in this log. An
        epoch in which the track is doubtful waits for the next ``LOOK_AHEAD`` epochs, which decide
        about it.
        """
        b = (b or self.start)._replace(tracked=False)
        waiting: list[Paths] = []
        for latest in chain(epochs, [None]):
            if latest is not None:
                waiting.append(latest)
            while waiting:
                paths, *others = waiting
                now_s = paths.time_s
                if not 0.0 < now_s - b.time_s <= GAP_S:  # live, a clock may be set back
                    b = b._replace(tracked=False)
                coming = [later for later in others if now_s < later.time_s <= now_s + GAP_S]
                decides = len(coming) >= LOOK_AHEAD or len(coming) < len(others)
                if latest is not None and not decides and _is_doubtful(b, paths):
                    break
                waiting = others
                b = self._advanced(b, paths, coming[:LOOK_AHEAD])
                yield b

    def _advanced(self, b: Belief, paths: Paths, coming: Sequence[Paths]) -> Belief:
        """Return the belief after an epoch; coming epochs decide what to do if it is doubtful."""
        if b.tracked and not _is_doubtful(b, paths):
            return self.step(b, paths)
        best = b._replace(time_s=paths.time_s, labels={}, begins=False)
        score = -np.inf
        if b.tracked:
            best, score = self._continued(b, paths, coming)
        of_map = reduced(b, [trusted(image) for image in b.images])
        shortest = np.argsort(paths.z[:, 0])
        for path in shortest[paths.straight[shortest]][:BEGINNINGS].tolist():
            rival = self.begun(self.prior(of_map, paths, path), paths, path)
            likelihood, used = self.ahead(rival, coming)
            # A wrong beginning may fit later paths, when its prediction has grown uncertain. The
            # next epoch may lack the line of sight.
            _, prompt = self.ahead(rival, coming[:2])
            fits = used >= FITS * len(coming) and prompt >= len(coming[:1])
            if fits and likelihood > score + CLEARLY:
                best = rival
                score = likelihood
        return best

    def _continued(self, b: Belief, paths: Paths, coming: Sequence[Paths]) -> tuple[Belief, float]:
        """Use or ignore the paths of an epoch; also return the log-likelihood of this decision."""
        using = self.step(b, paths)
        ignoring = self.step(b, paths.part(slice(0)))
        likelihood, used = self.ahead(using, coming)
        of_ignoring, _ = self.ahead(ignoring, coming)
        too_few = False
        if _is_lost(b):
            too_few = used < FITS * len(coming)
        else:
            likelihood += using.evidence
        if likelihood < of_ignoring or too_few:
            return ignoring, of_ignoring
        return using, likelihood

    def step(self, b: Belief, paths: Paths, sight_used: bool = False) -> Belief:
        """Return the belief after an epoch, as :meth:`ImageFilter.step` says."""
        b = self.predicted(b, paths.time_s)
        if not len(paths):
            return _aged(b, {})
        labels, nis, evidence = self._assign(b, paths, sight_used)
        used = {a: i for a, i in labels.items() if a == 0 or b.images[a - 1].confirmed}
        b = self.updated(b, paths, used, nis)
        short = bool(self._shorter(b, paths).any())
        # Also count paths of tentative images: a new track has no others besides the line of sight.
        likelihood = sum(evidence[a, i] for a, i in labels.items()) - SHORT_PENALTY * short
        doubt = Doubt(
            unused=0 if used else b.doubt.unused + 1,
            blind=0 if sight_used or 0 in used else b.doubt.blind + 1,
            short=b.doubt.short + 1 if short else 0,
        )
        b = b._replace(labels=used, evidence=float(likelihood), doubt=doubt)
        for anchor, path in labels.items():
            if anchor not in used:  # its noise is not inflated
                b = self.updated(b, paths, {anchor: path}, np.zeros_like(nis), block(anchor))
        hits = {a: float(nis[a, i]) for a, i in labels.items()}
        for path in self._unexplained(b, paths, labels):
            b = self.with_image(b, paths, path)
            hits[len(b.images)] = 0.0
        b = _aged(b, hits)
        # Receivers may report a path twice: an image at the base station is no reflection.
        apart = np.linalg.norm(b.places - self.station, axis=1) > LONGER_M
        return reduced(b, [apart[k] or image.exact for k, image in enumerate(b.images)])

    def _assign(
        self, b: Belief, paths: Paths, sight_used: bool
    ) -> tuple[dict[int, int], Array, Array]:
        """Return the path of each anchor that has one; NIS (A, n); and evidence (A, n), in nats.

        The assignment is a global nearest neighbor (Blackman and Popoli 1999, Sec. 6.4).
        """
        nis, log_det = self.nis(b, paths)
        density = [*DENSITY[:3], STATION_DENSITY if paths.at_station else DENSITY[3]]
        direct = paths.variance[:, 0]
        unknown = direct >= UNKNOWN_RAD**2  # these rows must not make a path likelier
        log_density = np.where(unknown, -0.5 * np.log(2.0 * PI * direct), np.log(density))
        limit = -2.0 * log_density.sum(axis=1) - LINK_ROWS * np.log(2.0 * PI)
        cost = nis + log_det - limit
        evidence = -0.5 * cost
        cost[0] = np.inf if sight_used else cost[0] - SIGHT_BONUS
        possible = np.flatnonzero(cost[0] < 0.0)
        if len(possible):  # of the paths that may be the line of sight, only the shortest may
            length = paths.z[possible, 0]
            variance = direct[possible, 0]
            shortest = length.argmin()
            apart = 3.0 * np.sqrt(variance + variance[shortest])
            cost[0, possible[length > length[shortest] + apart]] = 0.0
        return assign(cost, 0.0), nis, evidence

    def _shorter(self, b: Belief, paths: Paths) -> Mask:
        """Tell which paths (n,) are shorter than the line of sight, which is impossible."""
        d = b.x[USER] - self.station
        distance = np.linalg.norm(d)
        u = d / distance
        sigma = np.sqrt(u @ b.P[USER, USER] @ u + paths.variance[:, 0, 0])
        shorter = paths.z[:, 0] < distance - SHORT_SIGMAS * sigma - LONGER_M
        return paths.straight & shorter  # type: ignore[no-any-return]

    def _unexplained(self, b: Belief, paths: Paths, labels: Mapping[int, int]) -> list[int]:
        """Return the paths that may come from images that are still unknown."""
        nis, _ = self.nis(b, paths)
        longer = paths.z[:, 0] > np.linalg.norm(b.x[USER] - self.station) + LONGER_M
        free = np.flatnonzero(longer & (nis.min(axis=0) > FREE)).tolist()
        return [path for path in free if path not in labels.values()]


def _is_doubtful(b: Belief, paths: Paths) -> bool:
    """Return whether coming epochs must decide what to do with the paths of an epoch."""
    wrong = b.doubt.blind % 5 == 3 or b.doubt.unused >= 2 or b.doubt.short >= 2
    return len(paths) > 0 and (not b.tracked or wrong or _is_lost(b))


def _is_lost(b: Belief) -> bool:
    """Return whether the position of a track is hardly known."""
    return bool(np.linalg.eigvalsh(b.P[:2, :2])[-1] > LOST_M**2)


def _aged(b: Belief, hits: Mapping[int, float]) -> Belief:
    """Return the belief with images confirmed, removed and merged.

    ``hits`` are the NIS of all images that had a path in this epoch; 0 for a new image.
    """
    images = [_later(image, hits.get(anchor)) for anchor, image in enumerate(b.images, start=1)]
    b = b._replace(images=tuple(images))
    return merged(reduced(b, [_is_kept(image) for image in images]))


def _later(image: Image, nis: float | None) -> Image:
    """Return an image after an epoch with a path of this NIS, or without a path (None)."""
    later = image._replace(
        paths=image.paths + (nis is not None),
        epochs=image.epochs + 1,
        missed=image.missed + 1 if nis is None else 0,
        nis=image.nis + (nis or 0.0),
    )
    if image.confirmed or later.paths < CONFIRM:
        return later
    fits = later.nis < chdtri(LINK_ROWS * (later.paths - 1), CONFIRM_TAIL)
    return later._replace(confirmed=bool(fits))


def _is_kept(image: Image) -> bool:
    """Return whether an image may still be one; a tentative one has few epochs to be confirmed."""
    if image.confirmed:
        return image.exact or image.missed <= KEEP * max(1.0, image.paths / CONFIRM)
    fresh = image.missed <= EPOCHS - CONFIRM and image.epochs < EPOCHS
    return fresh and image.paths < CONFIRM


def learn_map(
    logs: Sequence[PathLog], scene: Scene, radio: Radio, mode: Mode
) -> tuple[Scene, Json]:
    """Learn the images that several logs reveal, in order; see :class:`MapLearner`.

    Returns:
        The scene with the learned images as virtual anchors, for any log; and figures: the counts
        of epochs, of paths, of paths that they explain and of starts of tracks; and each image.

    Raises:
        LogError: no track begins in one of the logs, or the logs contradict the learned images of
            the scene.
    """
    learner = MapLearner(scene, radio, mode)
    belief = learner.start
    counts = {"epochs": 0, "paths": 0, "explained": 0, "starts": 0}
    for number, log in enumerate(logs, start=1):
        before = counts["starts"]
        counts["epochs"] += len(log.epochs)
        counts["paths"] += sum(map(len, log.epochs))
        for later in learner.follow(learner.observed(log), belief):
            counts["explained"] += len(later.labels)
            counts["starts"] += later.begins
            belief = later
        if counts["starts"] == before:
            raise LogError(
                f"log {number} of {len(logs)}: found no path with which a track can begin, "
                "expected an epoch with a line of sight (arrival and departure are opposite) whose "
                "position explains a path in each of the next epochs"
            )
    learned = learned_scene(scene, belief)
    require_same_images(scene, learned)
    return learned, {**counts, "images": _images(learned)}


def require_same_images(before: Scene, after: Scene) -> None:
    """Refuse a map that goes on from another one if an image moved, or if only others were seen.

    Raises:
        LogError: the base station, or the frame of the angles, is not where it was before, or the
            earlier map was wrong.
    """
    if not before.learned or not after.learned:
        return
    old, new = (
        np.array(scene.virtual_anchors_m)[-len(scene.learned) :] for scene in (before, after)
    )
    nearest = np.linalg.norm(new - old[:, None], axis=2).argmin(axis=1).tolist()
    images = [after.learned[k] for k in nearest]
    sigmas = [[image.sigma_m for image in each] for each in (images, before.learned)]
    moved = abs(new[nearest] - old)
    far = (moved > MOVED_SIGMAS * np.linalg.norm(sigmas, axis=0)).any(axis=1) & (
        moved.max(axis=1) < SAME_M
    )
    gained = sum(image.paths for image in images) - sum(image.paths for image in before.learned)
    if far.any() or (gained < TRUSTED and len(new) > len({*nearest})):
        raise LogError(
            f"learned: found images at {new.round(1).tolist()} m, expected them at "
            f"{old.round(1).tolist()} m as in the scene. The base station or the frame of the "
            "angles is elsewhere than in earlier logs, or the map was wrong: learn anew from the "
            "base station alone, with all logs of the place in order"
        )


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
        normal /= np.linalg.norm(normal)
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
