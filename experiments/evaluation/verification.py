"""Verification of entries: whether a policy is the one that was judged, and reaches its figures.

An entry names its policy, the hash of its file, and figures at every site. To verify it, the policy
plays again: at two sites, chosen anew each time, the claimed episodes, and then episodes of seeds
that nobody could know before. An entry must equal the first, and fit the second statistically.
"""

import math
import secrets
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.evaluation.branches import CLAIRVOYANT
from experiments.evaluation.contenders import BEST_IMM, fingerprint
from experiments.evaluation.intervals import Interval
from experiments.evaluation.protocol import KINDS, Site, judge, read_entry, sites
from mmwave_env.io.files import Json

SITES = 2  # number of sites at which an entry plays again
HIDDEN = 50  # number of episodes of unknown seeds at each of them
# first and last of the test seeds from which they are drawn; results are published on lower ones
HIDDEN_SEEDS = (1_000_000, 4_999_950)
# largest difference of figures on the same episodes, in widths of their interval: other
# processors round differently, which matters in the few episodes in which filters are lost
SAME = 0.1
SURELY = 4.5  # standard deviations that a mean of hidden episodes may differ from the claim


def verify(path: Path) -> list[str]:
    """Verify the entry in a file; return what differs, or nothing.

    Raises:
        ValueError: the entry is invalid or was changed, or its policy can't be loaded.
        FileNotFoundError: there is no such file, or the policy's file is missing.
    """
    claimed = read_entry(path)
    policy = fingerprint(claimed["entry"])
    if policy != claimed["policy"]:
        return [
            f"policy: found the hash {policy}, expected {claimed['policy']}; the policy's file or "
            "module is not the one that was judged"
        ]
    differences = [*_inconsistent(claimed)]
    for site in secrets.SystemRandom().sample(sites(), SITES):
        differences += _differences(claimed, site)
    return differences


def _inconsistent(claimed: Json) -> Iterator[str]:
    """Yield what in an entry does not follow from its other figures, or from the protocol."""
    for site in sites():
        stated = claimed["sites"][site.name]
        if stated["kind"] != site.kind:
            yield f"{site.name}, kind: found {stated['kind']!r}, expected {site.kind!r}"
        for figure, claim in _figures(stated).items():
            if not math.isfinite(claim.mean):
                yield f"{site.name}, {figure}: found {claim.mean}, expected a finite number"
    if claimed["entry"] in (BEST_IMM, CLAIRVOYANT):
        return
    for kind in KINDS:
        at = [figures for figures in claimed["sites"].values() if figures["kind"] == kind]
        mean = float(np.mean([figures["minus"][BEST_IMM]["mean"] for figures in at]))
        stated = claimed["mean_gain"][kind]["mean"]
        if not math.isclose(mean, stated, rel_tol=1e-6, abs_tol=1e-9):
            yield f"mean_gain, {kind}: found {stated:.4f}, expected {mean:.4f}"


def _differences(claimed: Json, site: Site) -> Iterator[str]:
    """Let the policy play at a site again; yield what differs from the entry."""
    name = claimed["entry"]
    stated = claimed["sites"][site.name]
    claims = _figures(stated)
    again = _played(name, site, stated["episodes"], claimed["options"]["seed"])
    seed = secrets.choice(range(*HIDDEN_SEEDS))
    hidden = _played(name, site, HIDDEN, seed)
    for figure, same in again.items():
        claim = claims[figure]
        most = SAME * (same.high - same.low) + 1e-9
        if not (abs(np.subtract(claim, same)) <= most).all():
            yield f"{site.name}, {figure}: found {claim}, played {same}"
        other = hidden[figure]
        sigma = math.hypot(claim.high - claim.low, other.high - other.low) / (2.0 * 1.96)
        if not abs(claim.mean - other.mean) <= SURELY * sigma + 1e-9:
            yield (
                f"{site.name}, {figure}: found {claim.mean:.4f}, played {other.mean:.4f} on "
                f"{HIDDEN} episodes from seed {seed} on"
            )


def _played(name: str, site: Site, episodes: int, seed: int) -> dict[str, Interval]:
    return _figures(judge([name], site, episodes, seed).figures(name))


def _figures(stated: Json) -> dict[str, Interval]:
    """Return the figures at a site: reward, ATE, and gains over the rule (scores) and the IMMs."""
    named = {figure: stated[figure] for figure in ("reward", "ate_m", "over_rule")}
    named |= {f"minus {imm}": gain for imm, gain in stated["minus"].items()}
    return {figure: Interval.of(of) for figure, of in named.items()}
