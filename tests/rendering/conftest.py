"""Pictures need the extra ``render``; without it their tests are left out."""

from importlib.util import find_spec

collect_ignore_glob = [] if find_spec("pygame") else ["test_*.py"]
