"""What there is in the paths of a scenario: kinds of paths, anchors, and how often each is seen."""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from mmwave_env.episodes.deepmimo.anchors import find_links
from mmwave_env.episodes.deepmimo.paths import LINE_OF_SIGHT, Paths


@dataclass(frozen=True)
class AnchorCount:
    """An anchor that paths lead to.

    Attributes:
        station: name of the base station that it is, or an image of.
        kind: "base station", "image in a wall" or "image in the ground".
        position_m: of the anchor.
        epochs: in how many it is seen.
    """

    station: str
    kind: str
    position_m: tuple[float, float, float]
    epochs: int


@dataclass(frozen=True)
class Census:
    """What there is in the paths of E receivers.

    Attributes:
        epochs: E.
        paths: how many there are of each kind, such as "line of sight", over all stations.
        left_out: how many of them lead to no anchor.
        unseen: names of base stations without a line of sight at any epoch.
        anchors: of the other stations; base stations first, then those seen most.
    """

    epochs: int
    paths: dict[str, int]
    left_out: int
    unseen: tuple[str, ...]
    anchors: tuple[AnchorCount, ...]


def census(paths: Paths) -> Census:
    """Count what there is.

    Raises:
        ValueError: as of :func:`~mmwave_env.episodes.deepmimo.anchors.find_links`.
    """
    kinds: Counter[str] = Counter()
    anchors: list[AnchorCount] = []
    unseen, lead = [], 0
    for station in paths.stations:
        kinds.update(station.kinds())
        if not (station.interactions == LINE_OF_SIGHT).any():
            unseen.append(station.name)
            continue
        links = find_links(station, paths.position_m)
        lead += int(np.count_nonzero(links.member >= 0))
        for k, (place, epochs) in enumerate(
            zip(links.anchors_m.tolist(), links.epochs_seen.tolist(), strict=True)
        ):
            image = "image in the ground" if links.is_ground[k] else "image in a wall"
            anchors.append(AnchorCount(station.name, image if k else "base station", place, epochs))
    anchors.sort(key=lambda anchor: (anchor.kind != "base station", -anchor.epochs))
    return Census(len(paths.position_m), dict(kinds), sum(kinds.values()) - lead, tuple(unseen),
                  tuple(anchors))  # fmt: skip
