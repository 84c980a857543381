"""When to compile: not where plain Python is done sooner.

A process that steps one environment a few hundred times would spend most of its time compiling.
"""

from collections.abc import Callable
from typing import Any

from mmwave_env.compiler.disk_cache import compiled, is_compiled


class LazyJit:
    """A function that runs as plain Python until compiling it would have been quicker.

    What it calls has to run both ways, as ``numba.extending.register_jitable`` makes it.

    Args:
        function: what to run.
        plain_work: how much work a process does as plain Python, if it does not find the function
            on disk; in any unit, such as epochs.
    """

    def __init__(self, function: Callable[..., Any], plain_work: int) -> None:
        self.plain, self.compiled = function, compiled(function)
        self._left = plain_work

    def choice(self, work: int, *arguments: Any) -> Callable[..., Any]:
        """The plain or the compiled function, for so much work with such arguments.

        Choose once for work that is shared among threads.
        """
        if work <= self._left and not is_compiled(self.compiled, arguments):
            self._left -= work
            return self.plain
        self._left = 0
        return self.compiled  # type: ignore[no-any-return]

    def __call__(self, work: int, *arguments: Any) -> Any:
        """Do so much work, whichever way is quicker."""
        if not self._left:  # many steps come this way
            return self.compiled(*arguments)
        return self.choice(work, *arguments)(*arguments)
