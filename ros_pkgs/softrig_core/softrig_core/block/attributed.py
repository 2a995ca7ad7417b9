"""Blocks that still keep their state in attributes, behind the contract of those whose state is a value."""

from __future__ import annotations

from typing import Any

from .block import Block


def valued(block: Block) -> Any:
    """Give a block as one whose state is a value: itself where it is one."""
    return block if block.by_value() else Attributed(block)


class Attributed:
    """A block that holds its state itself; its x is the block."""

    def __init__(self, block: Block) -> None:
        self.block: Any = block
        self.change, self.finishes = block.change, block.finishes

    def first(self) -> Any:
        """As `reset` left it."""
        return self.block

    def outputs(self, x: Any, t: int) -> Any:
        """See `Plant.outputs`."""
        return self.block.outputs(t)

    def advance(self, x: Any, t: int, /, **inputs: Any) -> Any:
        """See `Plant.advance`."""
        self.block.advance(t, **inputs)
        return x

    def update(self, x: Any, t: int, /, **inputs: Any) -> Any:
        """See `Block.update`."""
        return x, self.block.update(t, **inputs)

    def finish(self, x: Any, t: int, /, **inputs: Any) -> Any:
        """See `Block.finish`."""
        return x, self.block.finish(t, **inputs)

    def refused(self, x: Any, t: int) -> Any:
        """See `Block.refused`."""
        return x, self.block.refused(t)

    def params(self, x: Any) -> Any:
        """Its `change` moves `p`."""
        return self.block.p

    def go_on(self, x: Any, before: Any) -> Any:
        """Its `change` has done that."""
        return x

    def status(self, x: Any) -> Any:
        """See `Observer.status`."""
        return self.block.status()

    def health(self, x: Any) -> Any:
        """See `Block.health`."""
        return self.block.health()

    def markers(self, x: Any) -> Any:
        """See `Block.markers`."""
        return self.block.markers()

    def save(self, x: Any) -> Any:
        """Copy what its attributes hold."""
        from .memory import Memory

        memory = Memory({self.block.name: [self.block]})
        return memory, memory.save()

    def load(self, saved: Any) -> Any:
        """Put it back."""
        memory, kept = saved
        memory.restore(kept)
        return self.block
