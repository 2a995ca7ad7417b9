"""A copy of this process that forks workers later, when this process has threads and must not be copied any more."""

from __future__ import annotations

import os
import signal
import socket
from contextlib import suppress
from multiprocessing import connection, forkserver
from typing import Any


class Template(forkserver.ForkServer):
    """The fork server of `multiprocessing`, as a copy of this process in place of a new interpreter.

    Until `close` the context ``forkserver`` uses it. Its workers share all that this process had imported and compiled
    when it was made. It must be made while the process has a single thread.
    """

    def __init__(self) -> None:
        super().__init__()
        with socket.socket(socket.AF_UNIX) as listener:
            address: Any = connection.arbitrary_address("AF_UNIX")  # type: ignore[attr-defined]
            listener.bind(address)
            listener.listen()
            ended, alive = os.pipe()
            if (pid := os.fork()) == 0:
                # The child must not hold this end itself, or it would never see it closed.
                os.close(alive)
                _serve(listener.detach(), ended)
            os.close(ended)
        self._forkserver_address, self._forkserver_alive_fd, self._forkserver_pid = address, alive, pid
        self._usual = forkserver.connect_to_new_process
        forkserver.connect_to_new_process = self.connect_to_new_process

    def close(self) -> None:
        """End it; its workers continue."""
        forkserver.connect_to_new_process = self._usual
        self._stop()  # type: ignore[attr-defined]


def _serve(listener: int, ended: int) -> None:
    # A fork inherits the handler of its parent, which would not end this process.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    # Whatever happens, this copy must not return into the program that it was copied from.
    with suppress(BaseException):
        # It ends when the other end of the pipe is closed, by `close` or with the process.
        forkserver.main(listener, ended, [])
    os._exit(0)
