"""Code that needs numba: the type of our functions, and a cache of native code whose files are named by digests.

numba's own cache keys a function by the date of its file. It therefore keeps old code when a function called in
another file changes, and two processes that compile at the same time may corrupt its index. Here a file is named by a
digest of everything that affects its content, and is moved into place as a whole. So any number of processes may
compile the same function at the same time.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .compiled import cache_folder, store


class Cache:
    """Native code of one function, with a file for each signature, by the interface of numba's dispatcher.

    Parameters
    ----------
    name : str
        Name of the function, for readers of the folder.
    digest : str
        Digest of everything that affects the code, except the types of the arguments and the processor.
    unnamed : tuple of bytes
        Native code is not stored if its file contains one of these.
    """

    def __init__(self, name: str, digest: str, unnamed: tuple[bytes, ...] = ()) -> None:
        try:
            self.cache_path = str(cache_folder() / "numba")
        except OSError:
            # Without a folder nothing is found in this path and nothing can be stored.
            self.cache_path = os.devnull
        self._name = "".join(c if c.isalnum() or c in "._" else "" for c in name)
        self._digest, self._unnamed = digest, unnamed

    def has(self, signature: Any, target: Any) -> bool:
        """Return whether code for arguments of these types is stored."""
        return self._file(signature, target).exists()

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the compiled function; None when the cache does not have it or cannot be read."""
        from numba.core.compiler import CompileResult

        # As in numba's own cache: the target may not be initialised before the first compilation of a process.
        target.refresh()
        try:
            content = self._file(signature, target).read_bytes()
            return CompileResult._rebuild(target, *pickle.loads(content))  # type: ignore[no-untyped-call]
        except FileNotFoundError:
            return None
        # The unpickler may raise anything for a damaged file, which is then compiled again and replaced.
        except Exception:
            return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep a compiled function; without a writable folder it is compiled again in the next process."""
        from numba.core.serialize import dumps

        # Addresses of this process are not valid in another one, and a function among the arguments has no name there.
        if compiled.library.has_dynamic_globals or "Dispatcher" in str(signature):
            return
        content = dumps(compiled._reduce())  # type: ignore[no-untyped-call]
        if any(word in content for word in self._unnamed):
            return
        path = self._file(signature, compiled.target_context)
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            store(path, content)

    def _file(self, signature: Any, target: Any) -> Path:
        import numba

        # Code of another processor may not run here, and other versions of numba or Python may not read the file.
        key = (self._digest, str(signature), target.codegen().magic_tuple(), numba.__version__, sys.version)
        digest = hashlib.sha256(repr(key).encode()).hexdigest()[:32]
        return Path(self.cache_path, f"{self._name}-{digest}.nbc")


def teach(numba: Any, functions: type, power: Callable[[float, float], float]) -> None:
    """Register our functions with numba, and the C library's under names that its optimiser does not know.

    Parameters
    ----------
    functions : type
        `Jit`.
    power : callable
        Function of two floats that native code replaces by the C library's pow.
    """
    from llvmlite import binding
    from numba.core import types
    from numba.core.typing.typeof import typeof_impl
    from numba.extending import overload

    @typeof_impl.register(functions)
    def _type(value: Any, _: Any) -> Any:
        return value.dispatcher(numba)._numba_type_

    # Under its own name the optimiser would turn constant powers into products, exp2 or square roots, with other bits.
    binding.add_symbol("softrig_pow", ctypes.cast(ctypes.CDLL(None).pow, ctypes.c_void_p).value)
    library_pow: Any = types.ExternalFunction("softrig_pow", types.float64(types.float64, types.float64))

    @overload(power)
    def _power(x, y):  # type: ignore[no-untyped-def] # numba compares the two lists of arguments, annotations too
        return lambda x, y: library_pow(float(x), float(y))
