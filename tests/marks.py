"""Marks of tests that are too slow for `make test`."""

import pytest


def representative(cases, *quick):
    """All cases, those that are not named as slow: of one kind, each takes long."""
    return [case if case in quick else pytest.param(case, marks=pytest.mark.slow) for case in cases]
