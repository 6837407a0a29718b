"""Fences between shared memory that is written and the counter that announces it.

Processes share memory without locks: one writes content and then a counter, the other reads the
counter and then content. A processor may reorder the two for other processors. With a release fence
before the counter is written and an acquire fence after it was read, content is seen as it was
written (ISO C 2011, 7.17.4; Boehm and Adve, *Foundations of the C++ concurrency memory model*, PLDI
2008). x86 keeps these orders by itself, so nothing is done there. Python's own compiler reorders
nothing.
"""

from __future__ import annotations

import platform
from collections.abc import Callable

__all__ = ["ORDERED", "acquire", "compiled_fences", "release"]

ORDERED = ("x86_64", "i686")
"""Machines that reorder neither two stores nor two loads (total store order)."""

Fence = Callable[[], None]


def compiled_fences() -> tuple[Fence, Fence]:
    """Return functions for a release and an acquire fence of this processor."""
    from numba import njit, types
    from numba.extending import intrinsic

    def fence(ordering: str) -> Fence:
        @intrinsic
        def instruction(typing):  # type: ignore[no-untyped-def]  # noqa: ARG001
            def emit(context, builder, signature, arguments):  # type: ignore[no-untyped-def]  # noqa: ARG001
                builder.fence(ordering)
                return context.get_dummy_value()

            return types.void(), emit

        @njit(nogil=True)
        def call() -> None:
            instruction()  # type: ignore[call-arg]

        call()
        return call

    return fence("release"), fence("acquire")


def _nothing() -> None:
    return


release: Fence
acquire: Fence
release, acquire = (_nothing, _nothing) if platform.machine() in ORDERED else compiled_fences()
