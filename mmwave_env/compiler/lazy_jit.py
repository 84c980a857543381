"""Functions that are compiled only once the work they have to do is worth the compile time.

A process that steps one environment a few hundred times would spend most of its time compiling,
so small amounts of work run as plain Python.
"""

from collections.abc import Callable
from typing import Any

from mmwave_env.compiler.disk_cache import compiled, is_compiled


class LazyJit:
    """A function that runs as plain Python until it has done a given amount of work.

    After that, or as soon as its compiled form is found on disk, the compiled form runs. What the
    function calls must run both ways, as ``numba.extending.register_jitable`` makes it.

    Args:
        function: what to run.
        plain_work: how much work a process does as plain Python before it compiles, if the
            compiled function is not on disk yet; in any unit, such as epochs.
    """

    def __init__(self, function: Callable[..., Any], plain_work: int) -> None:
        self.plain, self.compiled = function, compiled(function)
        self._left = plain_work

    def choice(self, work: int, *arguments: Any) -> Callable[..., Any]:
        """The plain or the compiled function, for an amount of work with such arguments.

        Where threads share the work, choose once for all of them.
        """
        if work <= self._left and not is_compiled(self.compiled, arguments):
            self._left -= work
            return self.plain
        self._left = 0
        return self.compiled  # type: ignore[no-any-return]

    def __call__(self, work: int, *arguments: Any) -> Any:
        """Do an amount of work, as plain Python or compiled."""
        if not self._left:  # many steps come this way
            return self.compiled(*arguments)
        return self.choice(work, *arguments)(*arguments)
