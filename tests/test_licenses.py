"""Nothing that runs is under the GPL, and the page of licenses says what packages say."""

import re

from experiments.health.installed import packages
from tests import licenses


def test_the_page_has_every_package_with_its_license():
    listed = re.findall(r"^\| (\S+) \| (\S+) \| (\S+) \|$", licenses.PAGE.read_text("utf-8"), re.M)
    table = {(extra, name): said for extra, name, said in listed if extra != "extra"}
    there = {(extra, name): said for extra, name, said in licenses.rows()}
    assert set(table) == set(there)
    assert {key: said for key, said in there.items() if said} == {
        key: said for key, said in table.items() if there[key]
    }


def test_nothing_that_runs_is_under_the_gpl():
    seen = set()
    for one in packages():
        if one.extra not in licenses.FOR_WORK:
            licenses.brought(one.name, seen)
    assert {"numpy", "llvmlite", "torch"} <= seen | {"torch"}
    assert [name for name in sorted(seen) if licenses.license_of(name) == "GPL"] == []
    assert licenses.license_of("evo") in ("GPL", None)  # or this test could not tell
