"""Casadi functions as native code: C generated, compiled once into a cache, called through buffers.

A plant's equations are written once as casadi expressions with the fixed integration step inside. Called
from Python the usual way, such a function costs a hundred microseconds; its C code through casadi's buffer
interface costs about one. Without a C compiler the same function runs in casadi's virtual machine, with the
same operations in the same order, only slower.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import os
import re
import shutil
import stat
import struct
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cached_property, lru_cache
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import casadi as ca
    import numpy as np
    from numpy.typing import NDArray

# No contraction into fused multiply-adds: the numbers must not depend on the processor.
FLAGS = ("-O2", "-fPIC", "-shared", "-ffp-contract=off")
# In casadi's C: a line that loads an input, one that computes a number, a square, and a line that stores a result.
LOADS = re.compile(r"(a\d+)=arg\[(\d+)\]\? arg\[\d+\]\[(\d+)\] : 0;")
COMPUTES = re.compile(r"a\d+=(?:a\d+|\d+\.\d*(?:e[-+]?\d+)?|[-+*/()])+;")
SQUARES = re.compile(r"casadi_sq\((a\d+)\)")
STORES = re.compile(r"if \(res\[(\d+)\]!=0\) res\[\d+\]\[(\d+)\]=(a\d+);")
# TMPDIR may differ between the processes of a user, but they must find the same locks.
TEMPORARY = Path("/tmp")


class _Buffer:
    """Memory for one call of a casadi function at a time: flat arguments and results."""

    def __init__(self, function: ca.Function) -> None:
        self.arguments = bytearray(8 * function.nnz_in())
        self.results = bytearray(8 * function.nnz_out())
        self._buffer, self.run = function.buffer()
        # casadi keeps bare addresses: the memoryviews must live as long as the buffer
        self._views = [memoryview(self.arguments).cast("d"), memoryview(self.results).cast("d")]
        offset = 0
        for i in range(function.n_in()):
            self._views.append(self._views[0][offset : offset + function.nnz_in(i)])
            self._buffer.set_arg(i, self._views[-1])  # type: ignore[call-arg, arg-type]
            offset += function.nnz_in(i)
        offset = 0
        for i in range(function.n_out()):
            self._views.append(self._views[1][offset : offset + function.nnz_out(i)])
            self._buffer.set_res(i, self._views[-1])  # type: ignore[call-arg, arg-type]
            offset += function.nnz_out(i)


class Compiled:
    """A casadi function called with one flat sequence of numbers, giving one flat tuple.

    Parameters
    ----------
    function : casadi.Function
        All inputs and outputs dense. A matrix is flattened column after column.

    Attributes
    ----------
    native : bool
        Whether compiled code runs; False in casadi's virtual machine.
    n_in, n_out : int
        Number of all inputs, of all outputs.
    symbol : str or None
        A name for the compiled code that no other code has.
    source : str
        The C that casadi has written; empty in the virtual machine.

    Examples
    --------
    >>> step = Compiled(casadi.Function("step", [x, u, h], [x_next]))
    >>> x = step((*x, *u, 1e-3))
    """

    # Each call writes the whole buffer before it reads it, so nothing of a tick is left in it.
    SCRATCH = frozenset({"_spare"})

    def __init__(self, function: ca.Function) -> None:
        for i in range(function.n_in()):
            if not function.sparsity_in(i).is_dense():
                raise ValueError(f"input {function.name_in(i)} of {function.name()} is sparse, expected dense")
        for i in range(function.n_out()):
            if not function.sparsity_out(i).is_dense():
                raise ValueError(f"output {function.name_out(i)} of {function.name()} is sparse, expected dense")
        library = build(function)
        self.native = library is not None
        self.n_in, self.n_out = function.nnz_in(), function.nnz_out()
        self.symbol = None if library is None else library.stem.replace("-", "_")
        self.source = ""
        if library is not None:
            import casadi as ca

            self.source = _source(function)
            function = ca.external(function.name(), str(library))
        n_in, n_out = self.n_in, self.n_out
        self._pack = struct.Struct(f"{n_in}d").pack_into
        self._library = library
        self._unpack = struct.Struct(f"{n_out}d").unpack
        self._function = function
        self._spare: list[_Buffer] = []

    def __call__(self, values: Sequence[float]) -> tuple[float, ...]:
        """Evaluate the function.

        Parameters
        ----------
        values : sequence of float
            All inputs one after the other.

        Returns
        -------
        tuple of float
            All outputs one after the other.

        Raises
        ------
        struct.error
            Wrong number of values.
        """
        try:
            buffer = self._spare.pop()
        except IndexError:  # another thread is using it, since runs of one robot share its functions
            buffer = _Buffer(self._function)
        self._pack(buffer.arguments, 0, *values)
        buffer.run()
        result = self._unpack(buffer.results)
        self._spare.append(buffer)
        return result

    @cached_property
    def places(self) -> tuple[int, int, int, int]:
        """Return the first index of each of the four tables in `scratch`: arguments, results, integers, numbers."""
        f = self._function
        arguments = self.n_in + self.n_out
        results = arguments + f.sz_arg()
        integers = results + f.sz_res()
        return arguments, results, integers, integers + f.sz_iw()

    @property
    def address(self) -> int:
        """Return the address of the C function (casadi_real** arg, res, casadi_int* iw, casadi_real* w, mem)."""
        result = getattr(ctypes.CDLL(str(self._library)), self._function.name())
        return ctypes.cast(result, ctypes.c_void_p).value or 0

    @property
    def title(self) -> str:
        """Name of the function in `source`."""
        return str(self._function.name())

    @cached_property
    def sizes(self) -> tuple[list[int], list[int], int, int, int, int]:
        """Return the sizes of each input and output, then the work space that a call needs: arg, res, iw, w."""
        f = self._function
        inputs, outputs = [f.nnz_in(k) for k in range(f.n_in())], [f.nnz_out(k) for k in range(f.n_out())]
        return inputs, outputs, f.sz_arg(), f.sz_res(), f.sz_iw(), f.sz_w()

    @cached_property
    def arithmetic(self) -> list[str]:
        """Return `source` as statements of Python that compute results r0, r1, ... from inputs v0, v1, ...

        The operations and their order are those of C, so the bits are, too. The list is empty if the source has
        anything but sums, differences, products and quotients.
        """
        # The source consists of one operation a line if the function is one of scalars.
        inputs, outputs = ([0, *accumulate(sizes)] for sizes in self.sizes[:2])
        body = self.source.partition("static int casadi_f0(")[2].partition(" {\n")[2].partition("  return 0;\n")[0]
        result = []
        for line in map(str.strip, SQUARES.sub(r"(\1*\1)", body).splitlines()):
            if loads := LOADS.fullmatch(line):
                # A call converts whole numbers, too.
                result.append(f"{loads[1]} = float(v{inputs[int(loads[2])] + int(loads[3])})")
            elif stores := STORES.fullmatch(line):
                result.append(f"r{outputs[int(stores[1])] + int(stores[2])} = {stores[3]}")
            elif COMPUTES.fullmatch(line):
                result.append(line.rstrip(";"))
            elif not line.startswith("casadi_real a"):
                return []
        return result

    def scratch(self) -> NDArray[np.float64]:
        """Return memory for calls from native code: inputs, outputs, then the parts of `places` with addresses set."""
        import numpy as np

        (inputs, outputs, *_, numbers), places = self.sizes, self.places
        # Native code gets one array for each function, so the addresses are stored among the numbers.
        memory = np.zeros(places[3] + max(1, numbers))
        words, address = memory.view(np.int64), memory.ctypes.data
        for sizes, place in ((inputs, places[0]), (outputs, places[1])):
            for k, size in enumerate(sizes, place):
                words[k] = address
                address += 8 * size
        return memory


def cache_folder() -> Path:
    """Return the folder of compiled code and locks: ``$XDG_CACHE_HOME/softrig``, by default ``~/.cache/softrig``.

    If that is impossible (no home, or a read-only one), ``/tmp/softrig-UID`` is used, but only if no other user may
    write to it, because its content is executed.

    Raises
    ------
    OSError
        Both are impossible.
    """
    base = os.environ.get("XDG_CACHE_HOME")
    # `Path.home` raises a RuntimeError for a user without a home.
    with suppress(OSError, RuntimeError):
        folder = (Path(base) if base else Path.home() / ".cache") / "softrig"
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK | os.X_OK):
            return folder
    folder = TEMPORARY / f"softrig-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    state = folder.lstat()
    # Anyone may create a folder in /tmp, and what is in this one is executed.
    if not stat.S_ISDIR(state.st_mode) or state.st_uid != os.getuid() or state.st_mode & 0o022:
        raise PermissionError(errno.EPERM, "expected a folder that only this user may write into", str(folder))
    return folder


def kept(name: str, make: Callable[[Path], object]) -> Path:
    """Return a file of the cache, created first if it does not exist.

    Parameters
    ----------
    name : str
        With a digest of all that decides the content.
    make : callable
        See `moved`.
    """
    path = cache_folder() / name
    if not path.exists():
        moved(path, make)
    return path


def moved(path: Path, make: Callable[[Path], object]) -> None:
    """Create a file and move it into place; any number of processes may do so at the same time.

    Parameters
    ----------
    path : Path
        An existing file is replaced.
    make : callable
        Writes the file at the path that it receives, in an otherwise empty folder beside the target.
    """
    # Beside the place, because a file can only be renamed within one file system.
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        product = Path(scratch, "product")
        make(product)
        product.replace(path)


def store(path: Path, content: bytes) -> None:
    """Write a file that only this user can read, whole or not at all; see `moved`."""

    def make(product: Path) -> None:
        product.touch(0o600)
        product.write_bytes(content)

    moved(path, make)


def build(function: ca.Function) -> Path | None:
    """Compile a casadi function unless the cache has it.

    The file is named by a digest of the C source, the flags and the compiler's path, size and date; see `kept`.

    Returns
    -------
    Path or None
        The shared library; None without a usable compiler (a warning contains the reason).
    """
    compiler = shutil.which(os.environ.get("CC", "cc")) or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        warnings.warn(f"no C compiler found: {function.name()} runs about a hundred times slower", stacklevel=3)
        return None
    source = _source(function)
    # Another compiler may give other bits, so its path, size and date are part of the name of what it compiled.
    used = Path(compiler).stat()
    content = "\0".join((source, *FLAGS, compiler, str(used.st_size), str(used.st_mtime_ns)))
    digest = hashlib.sha256(content.encode()).hexdigest()[:32]

    def make(product: Path) -> None:
        code = product.with_name(f"{function.name()}.c")
        code.write_text(source)
        subprocess.run(
            [compiler, *FLAGS, str(code), "-o", str(product), "-lm"], check=True, capture_output=True, text=True
        )

    try:
        return kept(f"{function.name()}-{digest}.so", make)
    except (OSError, subprocess.CalledProcessError) as error:
        reason = (getattr(error, "stderr", "") or str(error)).strip().splitlines()[-1]
        warnings.warn(
            f"{compiler} could not compile {function.name()} ({reason}): it runs about a hundred times slower",
            stacklevel=3,
        )
        return None


# Both `build`, for the digest, and `Compiled.source` need the text of the same function.
@lru_cache(maxsize=64)
def _source(function: ca.Function) -> str:
    import casadi as ca

    generator = ca.CodeGenerator(function.name())
    generator.add(function)
    return str(generator.dump())
