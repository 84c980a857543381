"""Functions that flatten trees of numbers (such as the state of a track) and select among trees.

A *tree* is a number, or a list or NamedTuple of trees. The numbers in a tree are its leaves. A
workspace, the array that SIMD code works on, has one row for each leaf, in order.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

from mmwave_env.numerics.numbers import Number, Numbers, where

Tree = TypeVar("Tree")


def flatten(tree: Any) -> Numbers:
    """Return the numbers of a tree, in order."""
    if isinstance(tree, (list, tuple)):
        return [leaf for branch in tree for leaf in flatten(branch)]
    return [tree]


def unflatten(template: Tree, numbers: Iterator[Number]) -> Tree:
    """Return a tree of the template's shape, with the next of the ``numbers`` as its leaves."""
    if isinstance(template, list):
        return [unflatten(branch, numbers) for branch in template]  # type: ignore[return-value]
    if isinstance(template, tuple):
        branches = [unflatten(branch, numbers) for branch in template]
        return type(template)(*branches)
    return next(numbers)  # type: ignore[no-any-return]


def indices(template: Tree) -> Tree:
    """Return a tree of the template's shape whose leaves are 0, 1, 2, ... in order."""
    return unflatten(template, itertools.count())


def select(condition: Any, a: Tree, b: Any) -> Tree:
    """Apply ``where(condition, a, b)`` leaf by leaf; what both trees share needs no choice."""
    if a is b:
        return a
    if not isinstance(a, (list, tuple)):
        return where(condition, a, b)  # type: ignore[no-any-return]
    chosen = [select(condition, *pair) for pair in zip(a, b, strict=True)]
    return chosen if isinstance(a, list) else type(a)(*chosen)  # type: ignore[return-value]


def tree_at(index: Number, trees: Sequence[Tree]) -> Tree:
    """Return ``trees[index]``, where the value of ``index`` is known only at run time."""
    chosen = trees[0]
    for number, tree in enumerate(trees[1:], start=1):
        chosen = select(index > number - 0.5, tree, chosen)
    return chosen
