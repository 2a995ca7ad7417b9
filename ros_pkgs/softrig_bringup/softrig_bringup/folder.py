"""The folder of results: the files of an earlier run or study are replaced, nothing else is touched."""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from weakref import WeakSet

from softrig_core import RunError, ScenarioError
from softrig_core.guard import keep_traceback, naming, replace
from softrig_core.kit.file_format import json_object, json_of

MANIFEST = "softrig_files.json"
UNDER_WAY = "*"  # mark of a folder whose run has begun and not ended; it contains the run's `once`
NEW = ".new"  # folder of new files until all are written
RUN = re.compile(
    r"bag|log|left_\d+\.yaml|metrics\.json|report\.html|(overview|plot_\d\d_[a-z0-9_]*)\.(png|svg|pdf)|softrig_files\.json"
)
STUDY = re.compile(
    r"study\.(json|yaml)|rows\.jsonl|table\.(parquet|csv)|statistics\.(csv|tex)|summaries\.json|report\.html|softrig_files\.json|\.new"
)
FALSIFICATION = re.compile(
    r"falsification\.json|outcome\.json|rows\.jsonl|report\.html|nominal|worst|worst\.(png|svg|pdf)|small|\w+_(worst|small)\.yaml"
    r"|softrig_files\.json|\.new"
)
MARKS = {"metrics.json": "run", "study.json": "study", "falsification.json": "falsification"}


def kind_of(path: Path) -> str:
    """Return the kind of a folder's content: a value of `MARKS`, or empty."""
    return next((kind for mark, kind in MARKS.items() if (path / mark).is_file()), "")


_held: WeakSet[ResultsFolder] = WeakSet()


def _let_go_of_all() -> None:
    """Close the locks inherited by a fork; otherwise a worker that ends late would keep the folder locked."""
    for folder in list(_held):
        folder.let_go()


os.register_at_fork(after_in_child=_let_go_of_all)


class ResultsFolder:
    """A folder that a run or a study may write into.

    Parameters
    ----------
    path : Path
        A new folder, an empty one, or one with the results of an earlier run; it may also contain other files.
    pattern : pattern
        Names that this kind of run writes at the top level of the folder.

    Attributes
    ----------
    replaced : str
        A description of what an earlier run left there; empty if it left nothing.

    Raises
    ------
    ScenarioError
        The folder has a conflicting file that no run of softrig has listed as its own, or results of another kind.
    """

    def __init__(self, path: Path, pattern: re.Pattern[str] = RUN) -> None:
        self.path = path
        self._lock: int | None = None
        if path.exists() and not path.is_dir():
            raise ScenarioError(f"{path} is a file, expected a folder for the results")
        for mark, kind in MARKS.items():  # results of another kind may have taken hours, so they are not replaced
            if not pattern.fullmatch(mark) and (path / mark).exists():
                raise ScenarioError(f"{path} holds a {kind}; choose another --out, or remove it")
        self._old = _listed(path)
        self._broken_off = next((name for name in self._old if name.startswith(UNDER_WAY)), "")
        if self._broken_off:
            self._old.discard(self._broken_off)
            self._old |= {f for f in _files(path) if pattern.fullmatch(Path(f).parts[0])}
        self._foreign = {f for f in _files(path) if f not in self._old}
        for file in sorted(self._foreign):
            if pattern.fullmatch(Path(file).parts[0]):
                raise ScenarioError(_foreign(path / file))
        self.replaced = _title(path) if self._old & set(_files(path)) else ""

    def begin(self, once: str = "") -> None:
        """Create the folder, and note in it that a call is writing.

        A run that was killed, or refused by one of its nodes, must not block the next one, unless it cannot be
        reproduced.

        Parameters
        ----------
        once : str
            Why the results cannot be reproduced; empty if they can.

        Raises
        ------
        ScenarioError
            Nothing can be written there.
        """
        try:
            if (holder := self.hold()) is not None:
                raise ScenarioError(_writing(self.path, holder))
            self._list([MANIFEST, UNDER_WAY + once])
        except OSError as error:
            raise ScenarioError(f"{error.filename}: {error.strerror}; choose another --out") from None

    def hold(self) -> str | None:
        """Lock the folder against other calls until it is closed; return the present holder, or None."""
        if self._lock is None:
            lock = _lock(self.path)
            if isinstance(lock, str):
                return lock
            self._lock = lock
            _held.add(self)
        return None

    def let_go(self) -> None:
        """Release the lock on the folder."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def __del__(self) -> None:
        self.let_go()

    @property
    def broke(self) -> bool:
        """Return whether the run in the folder ended with an error."""
        return bool(json_object(self.path / "metrics.json").get("error"))

    def once(self, broken_off: Callable[[Iterable[Path]], Iterable[str]]) -> str:
        """Describe why results of the earlier run here cannot be made again; empty if they can.

        Parameters
        ----------
        broken_off : callable
            Called with the shards of a run that was killed; returns what in them cannot be reproduced.
        """
        try:
            content = json_of((self.path / "metrics.json").read_text())
            reasons, packages = list(content.get("once", ())), list(content.get("code", ()))
        except (OSError, ValueError, AttributeError, TypeError):
            log, left = self.path / "log", sorted(branch.name for branch in self.path.glob("left_*.yaml"))
            shards = sorted(log.glob("*.shard*"))
            if not self._broken_off or not (shards or left):
                return ""
            why = self._broken_off.removeprefix(UNDER_WAY) or ", ".join([*broken_off(shards), *left])
            return f"{why}, and broken off: softrig bag repair {log}" if why else ""
        reasons += [f"its package {name} is not installed here" for name in packages if find_spec(str(name)) is None]
        return ", ".join(map(str, reasons))

    def clear(self, once: str = "") -> None:
        """Remove the files listed by the earlier run, and the folders that are then empty; never the target of a link.

        Parameters
        ----------
        once : str
            See `begin`.
        """
        self.begin(once)
        try:
            for file in self._old - {MANIFEST}:
                target = self.path / file
                if _inside(self.path, target):
                    target.unlink(missing_ok=True)
        except OSError as error:
            raise ScenarioError(f"{error.filename}: {error.strerror}; choose another --out") from None
        for folder in sorted({p for f in self._old for p in Path(f).parents}, key=lambda p: -len(p.parts)):
            target = self.path / folder
            if folder.parts and target.is_dir() and not target.is_symlink() and not any(target.iterdir()):
                target.rmdir()

    def close(self) -> None:
        """List everything that this run has written, so that a later one may replace it."""
        self._list(sorted({MANIFEST, *(f for f in _files(self.path) if f not in self._foreign)}))

    @contextmanager
    def keeping(self) -> Iterator[None]:
        """Keep the traceback of an error of softrig itself in ``log/``, and list it; `guarded` then names that file."""
        try:
            yield
        except (ScenarioError, RunError, OSError, MemoryError):
            raise  # the caller reports it in one line
        except Exception as error:
            traceback = Path(keep_traceback(self.path / "log"))
            if traceback.is_relative_to(self.path):
                self._list(sorted({MANIFEST, *_listed(self.path), str(traceback.relative_to(self.path))}))
            vars(error)["log"] = str(traceback)
            raise
        finally:
            self.let_go()

    def _list(self, names: list[str]) -> None:
        replace(self.path / MANIFEST, json.dumps(names, indent=1) + "\n")

    @contextmanager
    def anew(self) -> Iterator[Path]:
        """Yield a temporary folder; its files replace the old ones when all are written, or none is replaced.

        Raises
        ------
        ScenarioError
            One of them would replace a file that softrig did not write.
        """
        self.begin()
        new = self.path / NEW
        shutil.rmtree(new, ignore_errors=True)  # a killed call has left it
        new.mkdir()
        try:
            with naming(self.path):
                yield new
            files = sorted(_files(new))
            for file in files:
                if file in self._foreign:
                    raise ScenarioError(_foreign(self.path / file))
            for file in files:
                (new / file).replace(self.path / file)
        finally:
            shutil.rmtree(new, ignore_errors=True)
        self.close()

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Lock the folder against other calls while the block runs.

        Raises
        ------
        ScenarioError
            Another call is at work there.
        """
        self.begin()
        try:
            yield
        finally:
            self.let_go()


@contextmanager
def alone_in(path: Path) -> Iterator[None]:
    """Lock a folder that is not a `ResultsFolder` against other calls; create it if needed.

    Raises
    ------
    ScenarioError
        Another call is at work there.
    """
    lock = _lock(path)
    if isinstance(lock, str):
        raise ScenarioError(_writing(path, lock))
    try:
        yield
    finally:
        os.close(lock)


def _lock(path: Path) -> int | str:
    """Create and lock a folder; return the descriptor that holds the lock, or a description of the present holder."""
    path.mkdir(parents=True, exist_ok=True)
    lock = os.open(path, os.O_RDONLY)  # the lock is released when this process ends, for any reason
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        return _holder(path)
    return lock


def _writing(path: Path, holder: str) -> str:
    return f"{path}: {holder} is writing there; wait for it, or choose another folder"


def _holder(path: Path) -> str:
    """Describe which process holds a folder, as the kernel lists its locks."""
    inode = str(path.stat().st_ino)
    with suppress(OSError):
        for line in Path("/proc/locks").read_text().splitlines():
            words = line.split()
            if "FLOCK" in words and words[5].rpartition(":")[2] == inode:
                return f"process {words[4]}"
    return "another process"


def _foreign(path: Path) -> str:
    return f"{path} was not written by a run of softrig (or by one before 0.2); move it away or choose another --out"


def _files(path: Path) -> Iterator[str]:
    """Yield every file below a folder by its relative path; links are files, and not followed."""
    for folder, folders, files in os.walk(path):
        links = [name for name in folders if (Path(folder) / name).is_symlink()]
        for name in [*files, *links]:
            yield str((Path(folder) / name).relative_to(path))


def _listed(path: Path) -> set[str]:
    try:
        content = json_of((path / MANIFEST).read_text())
    except (OSError, ValueError):
        return set()
    names = content if isinstance(content, list) else []
    return {n for n in names if isinstance(n, str) and not Path(n).is_absolute() and ".." not in Path(n).parts}


def list_too(file: Path) -> None:
    """Add a file to the list of a finished run, so that a later run there may replace it."""
    names = _listed(file.parent)
    if names and RUN.fullmatch(file.name) and not any(name.startswith(UNDER_WAY) for name in names):
        replace(file.parent / MANIFEST, json.dumps(sorted({*names, file.name}), indent=1) + "\n")


def _inside(path: Path, file: Path) -> bool:
    """Return whether the folder of a file is really below `path`, no link in between."""
    return file.parent.resolve().is_relative_to(path.resolve())


def _title(path: Path) -> str:
    content = json_object(path / "metrics.json")
    known = content.keys() >= {"scenario", "mode", "seed"}
    return f"{content['scenario']} ({content['mode']}, seed {content['seed']})" if known else "an earlier run"
