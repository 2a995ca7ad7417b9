"""A user's C as code that a rig can call: sources to a library, a header to a layout, both to a shim; cached by
content.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import re
import shutil
import subprocess
from collections.abc import Callable, Sequence
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import NamedTuple

from elftools.common.exceptions import ELFError
from elftools.elf.elffile import ELFFile
from elftools.elf.sections import SymbolTableSection
from softrig_core.kit.compiled import FLAGS, kept

from .layout import LayoutError, Leaf, Struct, structs

PATIENCE = 300.0  # s that a compiler may need
MACHINES = {"x86_64": "EM_X86_64", "aarch64": "EM_AARCH64"}
SHIM = ("-O2", "-ffp-contract=off", "-Wno-unused-function", "-Werror=incompatible-pointer-types")
PROTOTYPES = {
    "step": "int {n}_step({n} *s, const {n}_in *in, {n}_out *out, int64_t t_ns);",
    "outputs": "int {n}_outputs({n} *s, {n}_out *out, int64_t t_ns);",
    "advance": "int {n}_advance({n} *s, const {n}_in *in, int64_t t_ns);",
}
STEP, PLANT = ("step",), ("outputs", "advance")
ELSEWHERE = {"g++": ".cpp .cc .cxx .C", "gfortran": ".f90 .F90 .f95 .f .F"}  # compilers of other suffixes than .c
# objects that a linker, a C library or another language's runtime keeps in a library, beside the user's
_RUNTIME = ("completed", "__dso_handle", "__TMC_END__", "_edata", "_end", "__bss_start", "__data_start", "_GLOBAL_")
# Rust's standard library (a crate's name in a symbol is preceded by its length), and Fortran's type descriptors
_CRATES = (
    "std core alloc memchr gimli addr2line object miniz_oxide adler2 adler rustc_demangle hashbrown std_detect unwind "
    "panic_unwind panic_abort compiler_builtins"
)
_OTHERS = ("__rust", "rust_", "___def_init_", "___vtab_", *(f"{len(crate)}{crate}" for crate in _CRATES.split()))


# Functions that would end softrig itself, or change it for all of its nodes: a library that calls one runs in a process
# of its own.
INTRUSIVE = frozenset(
    ("exit", "_exit", "_Exit", "quick_exit", "pthread_exit", "execl", "execle", "execlp", "execv", "execve", "execvp")
    + ("execvpe", "fork", "vfork", "kill", "raise", "signal", "sigaction", "setrlimit", "chdir", "setlocale")
    + ("closefrom", "close_range", "_gfortran_stop_string", "_gfortran_stop_numeric", "_gfortran_error_stop_string")
    + ("_gfortran_error_stop_numeric", "_gfortran_runtime_error", "_gfortran_runtime_error_at", "_gfortran_os_error_at")
)
# flags with which a linker adds code that changes how the processor computes, for the whole process
FAST = ("-Ofast", "-ffast-math", "-funsafe-math-optimizations")


class Hidden(NamedTuple):
    """State that a library keeps outside its struct: names of variables, and their bytes."""

    names: tuple[str, ...]
    bytes: int

    def __str__(self) -> str:
        names = ", ".join(self.names[:5]) + ", ..." * (len(self.names) > 5)
        return names or f"{self.bytes} bytes of static data whose names are stripped"


class Built(NamedTuple):
    """Result of compiling a header and loading its library."""

    library: Path
    """A copy by content: the user may build the next one while this one runs."""

    shim: Path
    program: Path
    structs: dict[str, Struct]
    hidden: Hidden | None
    intrusive: tuple[str, ...]
    """Functions that it calls and that must not be called in softrig's own process."""

    digest: str


def compiler(name: str = "cc") -> str:
    """Find a compiler of this machine.

    Raises
    ------
    ValueError
        There is none.
    """
    wanted = os.environ.get("CC", "cc") if name == "cc" else name
    result = shutil.which(wanted) or (name == "cc" and (shutil.which("gcc") or shutil.which("clang"))) or None
    if result is None:
        package = {"g++": "g++", "gfortran": "gfortran"}.get(name, "gcc")
        raise ValueError(
            f"a C member needs a compiler, and there is no {wanted} here (Debian: apt-get install {package})"
        )
    return result


def compiled(sources: Sequence[Path], flags: Sequence[str]) -> Path:
    """Compile a user's sources to a shared library, unless the cache has it.

    The compiler must not contract operations into fused multiply-adds, so the numbers are those of the source.

    Parameters
    ----------
    sources : sequence of Path
        C, C++ or Fortran by their suffix.
    flags : sequence of str
        Further ones, such as ``-DREAL=float``.

    Raises
    ------
    ValueError
        The compiler refuses it; with its first error, which names file and line.
    """
    commands, content = [], hashlib.sha256("\0".join((*FLAGS, *flags)).encode())
    for source in sources:
        cc = compiler(next((c for c, suffixes in ELSEWHERE.items() if source.suffix in suffixes.split()), "cc"))
        if not cc.endswith("gfortran"):
            content.update(_ran([cc, "-E", "-P", *flags, str(source)], source))
        content.update(source.read_bytes() + _identity(cc).encode())
        commands.append(cc)
    main = next((c for c in commands if c != compiler()), commands[0])

    def make(product: Path) -> None:
        _ran([main, *FLAGS, "-g1", *flags, *map(str, sources), "-o", str(product), "-lm"], sources[0], product.parent)

    return kept(f"{sources[0].stem}-{content.hexdigest()[:32]}.so", make)


def built(library: Path, header: Path, prefix: str, plant: bool, flags: Sequence[str] = ()) -> Built:
    """Create the shim of a library and its header.

    Raises
    ------
    ValueError
        The library is not for this machine or lacks a function, or the header lacks a struct or has one that is not
        supported.
    """
    stamp = tuple((p, p.stat().st_mtime_ns, p.stat().st_size) for p in (library, header))
    return _built(stamp, prefix, plant, tuple(flags))


@lru_cache(maxsize=64)
def _built(stamp: tuple[tuple[Path, int, int], ...], prefix: str, plant: bool, flags: tuple[str, ...]) -> Built:
    library, header = stamp[0][0], stamp[1][0]
    content = library.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    methods = PLANT if plant else STEP
    hidden, intrusive = _inspect(library, [f"{prefix}_{name}" for name in ("init", *methods)])
    copy = kept(f"{library.stem.split('-')[0]}-{digest[:32]}.so", lambda product: _write(product, content))
    cc = compiler()
    text = _ran([cc, "-E", "-P", *flags, str(header)], header).decode(errors="replace")
    result = _structs(header, prefix, flags, text)
    generated = _generated(header, prefix, methods, result)
    shim = (resources.files(__package__) / "shim.c").read_text()
    key = hashlib.sha256("\0".join((generated, text, shim, *FLAGS, *flags, _identity(cc))).encode()).hexdigest()[:32]

    def make(*more: str) -> Callable[[Path], None]:
        def compile_(product: Path) -> None:
            folder = product.parent
            (folder / "layout.h").write_text(generated)
            (folder / "shim.c").write_text(shim)
            plain = [flag for flag in flags if flag not in FAST]
            try:
                _ran([cc, *SHIM, *more, *plain, "shim.c", "-o", str(product), "-ldl", "-lm"], header, folder)
            except ValueError as error:
                if "incompatible" not in str(error):
                    raise
                params = f", const {prefix}_params *params" * ("params" in result)
                raise ValueError(
                    f"{header.name} declares another prototype; expected void {prefix}_init({prefix} *s{params}); "
                    + " ".join(PROTOTYPES[m].format(n=prefix) for m in methods)
                ) from None

        return compile_

    shared = kept(f"shim_{prefix}-{key}.so", make("-fPIC", "-shared"))
    program = kept(f"shim_{prefix}-{key}", make("-DSR_PROGRAM"))
    # Each library has a file of its own: a shim that is loaded once binds one library, even if two have the same
    # layout.
    own_shim = kept(f"shim_{prefix}-{key}{digest[:16]}.so", lambda product: _write(product, shared.read_bytes()))
    return Built(copy, own_shim, program, result, hidden, intrusive, digest)


def _write(product: Path, content: bytes) -> None:
    product.write_bytes(content)


def _ran(command: list[str], about: Path, folder: Path | None = None) -> bytes:
    try:
        done = subprocess.run(
            command, capture_output=True, cwd=folder, stdin=subprocess.DEVNULL, check=False, timeout=PATIENCE
        )
    except subprocess.TimeoutExpired:
        raise ValueError(f"{command[0]} did not compile {about} within {PATIENCE:g} s") from None
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines() or [f"status {done.returncode}"]
        raise ValueError(f"{about.name} does not compile: {next((x for x in lines if 'error' in x), lines[-1])}")
    return done.stdout


@lru_cache(maxsize=8)
def _identity(command: str) -> str:
    used = Path(command).stat()
    return f"{command} {used.st_size} {used.st_mtime_ns}"


def _structs(header: Path, prefix: str, flags: tuple[str, ...], text: str) -> dict[str, Struct]:
    cc = compiler()
    digest = hashlib.sha256("\0".join((text, *flags, _identity(cc))).encode()).hexdigest()[:32]

    def make(product: Path) -> None:
        probe = product.parent / "probe.c"
        probe.write_text(f'#include "{header.resolve()}"\n')
        _ran(
            [cc, "-g", "-fno-eliminate-unused-debug-types", *flags, "-c", "probe.c", "-o", str(product)],
            header,
            probe.parent,
        )

    try:
        result = structs(kept(f"types_{prefix}-{digest}.o", make), prefix)
    except LayoutError as error:
        raise ValueError(f"{header.name}: {error}") from None
    for role, name in (("state", prefix), ("in", f"{prefix}_in"), ("out", f"{prefix}_out")):
        if role not in result:
            raise ValueError(
                f"{header.name} has no struct {name!r}; expected `typedef struct {{ ... }} {name};`, or "
                "another `prefix`"
            )
    return {role: _without_nothing(struct) for role, struct in result.items()}


def _without_nothing(struct: Struct) -> Struct:
    """Drop the dummy member that C requires in an empty struct."""
    return struct._replace(leaves=() if [leaf.access for leaf in struct.leaves] == ["nothing"] else struct.leaves)


def _inspect(library: Path, wanted: Sequence[str]) -> tuple[Hidden | None, tuple[str, ...]]:
    """Check that a file is a shared library of this machine with some functions; find hidden state and `INTRUSIVE`."""
    try:
        with library.open("rb") as file:
            elf = ELFFile(file)
            machine, kind = elf["e_machine"], elf["e_type"]
            native = MACHINES.get(platform.machine())
            if native is not None and machine != native:
                raise ValueError(
                    f"{library} is built for {machine.removeprefix('EM_')}, this machine is {platform.machine()}; "
                    "build it with this machine's compiler, or name its `sources`"
                )
            if kind != "ET_DYN":
                raise ValueError(f"{library} is not a shared library; build it with `cc -shared -fPIC`")
            tables = [s for s in elf.iter_sections() if isinstance(s, SymbolTableSection)]
            symbols = [s for table in tables if table.name == ".dynsym" for s in table.iter_symbols()]
            missing_here = {s.name for s in symbols if s["st_shndx"] == "SHN_UNDEF"}
            offered = {s.name for s in symbols if s["st_info"]["type"] == "STT_FUNC" and s["st_shndx"] != "SHN_UNDEF"}
            if missing := [name for name in wanted if name not in offered]:
                near = ", ".join(sorted(n for n in offered if not n.startswith("_"))[:8]) or "nothing"
                raise ValueError(
                    f'{library} has no function {missing[0]}; it offers {near} (a C++ function needs extern "C", a '
                    "static one is not offered)"
                )
            return _hidden(elf, tables), tuple(sorted(missing_here & INTRUSIVE))
    except (ELFError, UnicodeDecodeError, AttributeError, LookupError, TypeError, OverflowError) as error:
        raise ValueError(f"{library} is not a shared library ({error or 'not ELF'})") from None


def _hidden(elf: ELFFile, tables: Sequence[SymbolTableSection]) -> Hidden | None:
    sections = {
        k: s
        for k, s in enumerate(elf.iter_sections())
        if s.name.split(".")[1:2] in (["data"], ["bss"], ["tdata"], ["tbss"]) and not s.name.startswith(".data.rel.ro")
    }
    names: dict[str, int] = {}
    full = any(table.name == ".symtab" for table in tables)
    for table in tables:
        for symbol in table.iter_symbols():
            variable = symbol["st_info"]["type"] in ("STT_OBJECT", "STT_TLS") and symbol["st_shndx"] in sections
            if variable and symbol["st_size"] and not symbol.name.startswith(_RUNTIME) and not _is_others(symbol.name):
                names[_readable(symbol.name.rsplit(".", 1)[0])] = symbol["st_size"]
    if names:
        return Hidden(tuple(sorted(names)), sum(names.values()))
    size = sum(s["sh_size"] for s in sections.values())
    # The start code of a C library keeps up to 16 bytes in each shared library.
    return Hidden((), size) if not full and size > 16 else None


def _readable(name: str) -> str:
    """Return a name of C++ or Rust as its author wrote it, where the library of C++ is there."""
    if not name.startswith("_Z"):
        return name
    try:
        demangle = ctypes.CDLL("libstdc++.so.6")["__cxa_demangle"]
    except OSError:
        return name
    demangle.restype, status = ctypes.c_void_p, ctypes.c_int()
    address = demangle(name.encode(), None, None, ctypes.byref(status))
    if not address:
        return name
    text = ctypes.string_at(address).decode()
    ctypes.CDLL(None).free(ctypes.c_void_p(address))
    # Remove the hash that rustc appends.
    return re.sub(r"::h[0-9a-f]{16}$", "", text.replace("(anonymous namespace)::", ""))


def _is_others(name: str) -> bool:
    return any(prefix in name for prefix in _OTHERS)


# the shim's header ------------------------------------------------------------------------------------------------


def _generated(header: Path, prefix: str, methods: Sequence[str], values: dict[str, Struct]) -> str:
    state, ins, outs, params = (values.get(role, Struct((), ())) for role in ("state", "in", "out", "params"))
    arguments = {"step": "&s, &in, &out, t_ns", "outputs": "&s, &out, t_ns", "advance": "&s, &in, t_ns"}
    types = {
        "step": f"int (*)({prefix} *, const SR_IN *, SR_OUT *, int64_t)",
        "outputs": f"int (*)({prefix} *, SR_OUT *, int64_t)",
        "advance": f"int (*)({prefix} *, const SR_IN *, int64_t)",
    }
    takes = {"step": (1, 1, 1), "outputs": (0, 1, 0), "advance": (1, 0, 1)}
    init = f", const {prefix}_params *" if "params" in values else ""
    lines = [
        f'#include "{header.resolve()}"',
        "#include <math.h>",
        f"typedef {prefix} SR_STATE;",
        f"typedef {prefix}_in SR_IN;",
        f"typedef {prefix}_out SR_OUT;",
        f"enum {{ SR_STATES = {len(state.leaves)}, SR_INS = {len(ins.leaves)}, SR_OUTS = {len(outs.leaves)}, "
        f"SR_PARAMS = {len(params.leaves)} }};",
        f"typedef void (*sr_init_type)({prefix} *{init});",
        "#define SR_INIT_TYPE sr_init_type",
        "typedef struct {",
        *(f"    {types[m].replace('(*)', f'(*{m})')};" for m in methods),
        "} sr_methods_type;",
        "#define SR_METHODS_TYPE sr_methods_type",
        f"static inline double sr_put_state({prefix} *s, const double *v)",
        "{",
        "    (void)s; (void)v;",
        *(_put("s", leaf, k, True) for k, leaf in enumerate(state.leaves)),
        "    return 0.0;",
        "}",
        f"static inline double sr_take_state(const {prefix} *s, double *r)",
        "{",
        "    (void)s; (void)r;",
        *(_copy_out("s", leaf, k, True) for k, leaf in enumerate(state.leaves)),
        "    return 0.0;",
        "}",
        "static inline void sr_put_in(SR_IN *in, const double *v)",
        "{",
        "    (void)in; (void)v;",
        *(_put("in", leaf, k, False) for k, leaf in enumerate(ins.leaves)),
        "}",
        "static inline void sr_take_out(const SR_OUT *out, double *r)",
        "{",
        "    (void)out; (void)r;",
        *(_copy_out("out", leaf, k, False) for k, leaf in enumerate(outs.leaves)),
        "}",
        f"static inline int sr_same_constants(const {prefix} *a, const {prefix} *b)",
        "{",
        "    (void)a; (void)b;",
        *(f"    if (memcmp(&a->{c}, &b->{c}, sizeof a->{c}) != 0) return 0;" for c in state.constants),
        "    return 1;",
        "}",
        "static SR_INIT_TYPE sr_init_there;",
        "static SR_METHODS_TYPE sr_methods;",
        "static double sr_call_init(void *place, const double *v)",
        "{",
        *([f"    {prefix}_params p;", "    memset(&p, 0, sizeof p);"] if init else []),
        "    (void)v;",
        *(_put("(&p)", leaf, k, False) for k, leaf in enumerate(params.leaves)),
        f"    sr_init_there(({prefix} *)place{', &p' if init else ''});",
        "    return 0.0;",
        "}",
        "static const char *sr_bind(void *library)",
        "{",
        f'    if ((sr_init_there = (sr_init_type)dlsym(library, "{prefix}_init")) == NULL) return "{prefix}_init";',
        *(
            f'    if ((sr_methods.{m} = ({types[m]})dlsym(library, "{prefix}_{m}")) == NULL) return "{prefix}_{m}";'
            for m in methods
        ),
        "    return NULL;",
        "}",
        "#define SR_CALLS "
        + " ".join(
            f"SR_CALL(sr_{m}, {takes[m][0]}, {takes[m][1]}, {takes[m][2]}, (double)sr_methods.{m}({arguments[m]}))"
            for m in methods
        )
        + " static int (*const sr_functions[])(const double **, double **, long long *, double *, long long) = {"
        + ", ".join(f"sr_{m}" for m in methods)
        + "};"
        + " static const int sr_counts[][2] = {"
        + ", ".join(
            f"{{2 + SR_STATES + {takes[m][0]} * SR_INS, 1 + {takes[m][2]} * SR_STATES + {takes[m][1]} * SR_OUTS}}"
            for m in methods
        )
        + "};",
        # A wrong prototype is an error of the compiler here, not a crash in a run.
        f"static void sr_prototypes(void) {{ sr_init_type i = {prefix}_init; (void)i; "
        + " ".join(f"{types[m].replace('(*)', f'(*p_{m})')} = {prefix}_{m}; (void)p_{m};" for m in methods)
        + " }",
    ]
    return "\n".join(lines) + "\n"


def _put(struct: str, leaf: Leaf, k: int, exact: bool) -> str:
    """Write the line that copies number k into a struct; a value beyond the type is an error, or is limited."""
    target, value = f"{struct}->{leaf.access}", f"v[{k}]"
    if leaf.kind == "word":
        base, index = leaf.access[:-1].rsplit("[", 1)
        return f"    {{ uint32_t word = (uint32_t){value}; {_word(struct, base, index, '&word', True)} }}"
    if leaf.kind == "real":
        return f"    {target} = {value};"
    if leaf.kind == "bool":
        return f"    {target} = {value} != 0.0;"
    low, high = _limits(leaf)
    if exact:
        return f"    if (!({value} >= {low} && {value} <= {high})) return SR_RANGE + {k}; {target} = {value};"
    return f"    {target} = {value} < {low} ? {low} : {value} > {high} ? {high} : nearbyint({value});"


def _copy_out(struct: str, leaf: Leaf, k: int, exact: bool) -> str:
    """Write the line that copies a number out of a struct."""
    source = f"{struct}->{leaf.access}"
    if leaf.kind == "word":
        base, index = leaf.access[:-1].rsplit("[", 1)
        return f"    {{ uint32_t word = 0; {_word(struct, base, index, '&word', False)} r[{k}] = word; }}"
    lossy = (
        f" if ((double){source} > 9007199254740992.0 || (double){source} < -9007199254740992.0) return SR_RANGE + {k};"
    )
    return f"    r[{k}] = (double){source};" + (lossy if exact and leaf.bytes == 8 and leaf.whole else "")


def _word(struct: str, base: str, index: str, variable: str, put: bool) -> str:
    address = f"(char *)&{struct}->{base} + 4 * {index}"
    size = f"(sizeof {struct}->{base} - 4 * {index} < 4 ? sizeof {struct}->{base} - 4 * {index} : 4)"
    return f"memcpy({address}, {variable}, {size});" if put else f"memcpy({variable}, {address}, {size});"


def _limits(leaf: Leaf) -> tuple[str, str]:
    bits = 8 * leaf.bytes
    # Values are carried as doubles, which hold whole numbers exactly up to 2^53.
    if bits == 64:
        return ("-9007199254740992.0" if leaf.kind == "signed" else "0.0"), "9007199254740992.0"
    if leaf.kind == "unsigned":
        return "0.0", f"{2**bits - 1}.0"
    return f"{-(2 ** (bits - 1))}.0", f"{2 ** (bits - 1) - 1}.0"
