"""Process messages in the thread of the middleware that received them; rclpy offers no way to do this.

The functions are those of the rcl that rclpy itself is linked with. They are called through ctypes, which releases
Python's lock during the call: the thread that received a message holds the lock of its reader in Fast DDS while it
waits for Python's. For the same reason no code may take messages or events of such a reader, or create or destroy an
endpoint, while it holds Python's lock. rclpy does all of this under that lock.
"""

from __future__ import annotations

import ctypes
import importlib
import threading
from collections.abc import Callable
from typing import Any

import rclpy

from .uses import RCLError, works

# Only of this middleware is it known which calls are safe under the locks that it holds while it reports a message.
RMW = "rmw_fastrtps_cpp"
NAMES = (
    "rcl_subscription_set_on_new_message_callback",
    "rcl_take_serialized_message",
    "rcutils_reset_error",
    "rcl_subscription_get_publisher_count",
    "rcutils_get_default_allocator",
    "rcutils_uint8_array_init",
)
TAKE_FAILED = 401  # RCL_RET_SUBSCRIPTION_TAKE_FAILED: no message was available
SIZE = 4096  # bytes of a message to begin with; a longer one makes it grow


class _Allocator(ctypes.Structure):
    _fields_ = tuple((f"function_{k}", ctypes.c_void_p) for k in range(5))  # the last is a state


class Bytes(ctypes.Structure):
    """rcl_serialized_message_t."""

    _fields_ = (
        ("buffer", ctypes.c_void_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", _Allocator),
    )


_Callback = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_size_t)


def library() -> Any:
    """Return the library that `Arrival` calls, or None if it is missing or not known to be safe."""
    if rclpy.get_rmw_implementation_identifier() != RMW or not works("subscriptions"):
        return None
    try:
        # Through rclpy's own library its functions of rcl are found; loading rcl by name could load a second one.
        result = ctypes.CDLL(importlib.import_module("rclpy._rclpy_pybind11").__file__)
        for name in NAMES:
            getattr(result, name)
    except (ImportError, OSError, AttributeError):
        return None
    result.rcutils_get_default_allocator.restype = _Allocator
    return result


class Arrival:
    """Announces the messages of one subscription in the thread in which they arrive.

    Parameters
    ----------
    rcl : ctypes.CDLL
        From `library`.
    subscription : rclpy.subscription.Subscription
        One that no executor knows.
    receive : callable
        Gets the bytes of a message; it may publish, without effect if a signal has shut the context down.
    matched : callable
        Gets the number of writers when that has changed.
    arrive : callable
        Called for each new message in a thread of the middleware, with a callable that passes it to `receive`;
        raises nothing.
    """

    def __init__(
        self,
        rcl: Any,
        subscription: Any,
        receive: Callable[[bytes], object],
        matched: Callable[[int], object],
        arrive: Callable[[Callable[[], object]], object],
    ) -> None:
        self._rcl = rcl
        self.subscription = subscription  # lives as long as this
        self._reader = ctypes.c_void_p(subscription.handle.pointer)
        self._bytes = Bytes()
        self._where = ctypes.byref(self._bytes)
        allocator = rcl.rcutils_get_default_allocator()
        if rcl.rcutils_uint8_array_init(self._where, ctypes.c_size_t(SIZE), ctypes.byref(allocator)):
            raise MemoryError(f"{SIZE} bytes for messages on {subscription.topic_name}")
        self._matched = matched
        self._writers, self._counted = 0, ctypes.c_size_t()
        known: set[int] = set()
        hand_over = self._receiver(receive)

        def call(nothing: int, count: int) -> None:
            if (thread := threading.get_ident()) not in known:
                # Taken once more than it is released: otherwise Python would create its data of this thread again at
                # each message.
                ctypes.pythonapi.PyGILState_Ensure()
                known.add(thread)
            for _ in range(count):
                arrive(hand_over)

        self._call = _Callback(call)

    def begin(self) -> None:
        """Report writers from now on, including those that exist already."""
        self._set(self._call)

    def end(self) -> None:
        """Stop reporting; current reports finish first."""
        self._set(_Callback())

    def _set(self, call: Any) -> None:
        if self._rcl.rcl_subscription_set_on_new_message_callback(self._reader, call, None):
            self._rcl.rcutils_reset_error()
            raise RCLError(f"{self.subscription.topic_name}: cannot be notified of its messages")

    def report_writers(self) -> None:
        """Report the writers if their number has changed since the last check."""
        if self._rcl.rcl_subscription_get_publisher_count(self._reader, ctypes.byref(self._counted)):
            self._rcl.rcutils_reset_error()
        elif self._counted.value != self._writers:
            self._writers = self._counted.value
            self._matched(self._writers)

    def _receiver(self, receive: Callable[[bytes], object]) -> Callable[[], None]:
        """Return a function that takes the oldest message and passes it on; in a full queue a newer one replaced it."""
        accept, reader, buffer = self._rcl.rcl_take_serialized_message, self._reader, self._where
        bytes_now = memoryview(self._bytes).cast("B").cast("Q")  # where they are, how many, how many there may be
        room, content = 0, memoryview(b"")

        def hand_over() -> None:
            nonlocal room, content
            if result := accept(reader, buffer, None, None):
                self._failed(result)
                return
            # The buffer grows with a longer message and may then be at another address.
            if room != bytes_now[2]:
                room = bytes_now[2]
                content = memoryview((ctypes.c_uint8 * room).from_address(bytes_now[0])).cast("B")
            try:
                receive(bytes(content[: bytes_now[1]]))
            except RCLError:
                if rclpy.ok():
                    raise

        return hand_over

    def _failed(self, code: int) -> None:
        if code != TAKE_FAILED:
            self._rcl.rcutils_reset_error()
            raise RCLError(f"{self.subscription.topic_name}: a message cannot be received (rcl reports {code})")
