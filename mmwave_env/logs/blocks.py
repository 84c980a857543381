"""Blocks of consecutive epochs: cut, joined and handed on in whole windows."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, ClassVar, TypeVar

import numpy as np

from mmwave_env.logs.log_tables import LogError

AnyBlock = TypeVar("AnyBlock", bound="Block")


class Block:
    """T consecutive epochs, as a dataclass of arrays (T, ...) and of what they have in common."""

    per_epoch: ClassVar[tuple[str, ...]]  # names of the arrays; all else is that of the last epochs
    time_s: Any

    def __len__(self) -> int:
        return len(self.time_s)

    def part(self: AnyBlock, epochs: slice) -> AnyBlock:
        """Some of its epochs."""
        return self._with({name: getattr(self, name)[epochs] for name in self.per_epoch})

    @classmethod
    def joined(cls, blocks: Sequence[AnyBlock]) -> AnyBlock:
        """Blocks that follow each other as one."""
        return blocks[-1]._with(
            {name: np.concatenate([getattr(b, name) for b in blocks]) for name in cls.per_epoch}
        )

    def _with(self: AnyBlock, arrays: dict[str, Any]) -> AnyBlock:
        return replace(self, **arrays)  # type: ignore[type-var]


def in_windows(
    blocks: Iterable[AnyBlock], window: int, piece: Callable[[AnyBlock], int] = lambda block: 0
) -> Iterator[AnyBlock]:
    """The same epochs in blocks of whole windows, and what is left at the end of a piece.

    What came before a LogError of ``blocks`` is handed on before it. ``piece`` gives the number of
    the piece that a block belongs to; pieces are not joined.
    """
    waiting: list[AnyBlock] = []

    def rest() -> Iterator[AnyBlock]:
        if waiting:
            yield waiting[-1].joined(waiting)

    try:
        for block in blocks:
            if waiting and piece(block) != piece(waiting[0]):
                yield from rest()
                waiting = []
            waiting.append(block)
            if sum(map(len, waiting)) >= window:
                joined = block.joined(waiting)
                whole = len(joined) // window * window
                yield joined.part(slice(whole))
                waiting = [joined.part(slice(whole, None))] if whole < len(joined) else []
    except LogError:
        yield from rest()
        raise
    yield from rest()
