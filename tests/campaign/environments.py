"""Commands in strange environments: they succeed, or end with one line and a status; never a hang or a traceback."""

import ctypes
import os
import pty
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

from softrig_bags.cli import main_compare
from softrig_bringup.cli import main
from traces import orphans

ROOT = Path(__file__).parents[2]
SCENARIO = ["run", "dc_motor_smc_b2", "--duration", "0.05"]
STATUSES = {0, 1, 2, 3, 130, 141}
SILENT = ("Traceback (most recent call last)", "Exception ignored", "core dumped", "Fatal Python error")
LIMIT = 150.0  # s for one case


@dataclass
class Case:
    """One command and its environment."""

    directory: Path
    chance: random.Random
    command: list[str]
    variables: dict[str, str]
    stdout: int | None = None
    stderr: int | None = None
    before: list[Callable[[], object]] = field(default_factory=list)
    prefix: list[str] = field(default_factory=list)
    any_status: bool = False  # the case may break the interpreter itself

    @property
    def work(self) -> Path:
        """The current directory of the command."""
        return self.directory / "work"

    @property
    def out(self) -> Path:
        """The folder in which a run writes."""
        return self.work / "out"


@cache
def sound() -> Path:
    """Make the results of a run, for the commands that read one."""
    out = Path(mkdtemp()) / "sound"
    assert main([*SCENARIO, "--mode", "inprocess", "--out", str(out)]) == 0
    return out


def commands(chance: random.Random) -> list[str]:
    """Draw a command."""
    runs = [[*SCENARIO, "--mode", mode, "--out", "out"] for mode in ("inprocess", "processes", "container")]
    runs.append([*runs[0], "--no-plots"])
    others = [
        ["list"],
        ["list", "smc"],
        ["--help"],
        ["bag", "info", str(sound() / "bag")],
        ["completion"],
        ["compare", str(sound() / "bag"), str(sound() / "bag")],
        ["report", str(sound())],
        ["bag", "export", str(sound() / "bag"), "--out", "tables"],
        ["run", "no_such"],
        ["node", "softrig_drives", "dc_motor_plant", "--help"],
        ["node", "softrig_drives", "dc_motor_plant"],
        ["bag", "record", "--output", "out"],
    ]
    return chance.choice(runs if chance.random() < 0.5 else others)


def encodings(case: Case) -> None:
    """An output that lacks most characters."""
    case.variables |= case.chance.choice(
        (
            {"PYTHONIOENCODING": "ascii"},
            {"PYTHONIOENCODING": "latin-1"},
            {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
            {"LC_ALL": "xx_YY.nothing"},
            {"PYTHONIOENCODING": "utf-16"},
        )
    )


def closed(case: Case) -> None:
    """Standard streams that are closed."""
    numbers = case.chance.choice(((1,), (2,), (0, 1), (1, 2), (0, 1, 2), (0,)))
    case.before.append(lambda: [os.close(n) for n in numbers])


def full_output(case: Case) -> None:
    """An output onto a full disk."""
    full = os.open("/dev/full", os.O_WRONLY)
    if case.chance.random() < 0.7:
        case.stdout = full
    else:
        case.stderr = full


def gone_reader(case: Case) -> None:
    """A pipe that is not read."""
    reader, writer = os.pipe()
    os.close(reader)
    if case.chance.random() < 0.7:
        case.stdout = writer
    else:
        case.stderr = writer


def domains(case: Case) -> None:
    """An invalid ROS_DOMAIN_ID."""
    case.variables["ROS_DOMAIN_ID"] = case.chance.choice(("abc", "-1", "233", "9" * 30, "", " 5", "0x10", "1.5"))


def middlewares(case: Case) -> None:
    """A middleware that is not installed, or a rclpy that cannot be imported."""
    if case.chance.random() < 0.5:
        case.variables["RMW_IMPLEMENTATION"] = case.chance.choice(("rmw_nothing_cpp", "", "../x", "x" * 3000, "rmw_é"))
    else:
        (case.directory / "shadow").mkdir()
        (case.directory / "shadow/rclpy.py").write_text("raise ImportError('librmw.so: cannot open shared object')\n")
        case.variables["PYTHONPATH"] = f"{case.directory}/shadow:{case.variables.get('PYTHONPATH', '')}"


def ros_variables(case: Case) -> None:
    """ROS variables with meaningless values."""
    (case.directory / "bad.xml").write_text("<dds><profiles")
    pairs = (("ROS_AUTOMATIC_DISCOVERY_RANGE", "BOGUS"), ("ROS_LOCALHOST_ONLY", "2"), ("ROS_STATIC_PEERS", ";;;"),
             ("ROS_DISCOVERY_SERVER", "no:port"), ("FASTRTPS_DEFAULT_PROFILES_FILE", "/nonexistent.xml"),
             ("FASTRTPS_DEFAULT_PROFILES_FILE", str(case.directory / "bad.xml")), ("ROS_LOG_DIR", "/proc/nowhere"),
             ("RCUTILS_CONSOLE_OUTPUT_FORMAT", "{"), ("RCUTILS_LOGGING_BUFFERED_STREAM", "7"),
             ("RCUTILS_LOGGING_USE_STDOUT", "x"), ("RMW_FASTRTPS_PUBLICATION_MODE", "x"), ("ROS_DISTRO", "noetic"),
             ("ROS_SECURITY_ENABLE", "true"), ("ROS_DISABLE_LOANED_MESSAGES", "x"), ("ROS_HOME", "/proc/nowhere"),
             ("AMENT_PREFIX_PATH", ""), ("AMENT_PREFIX_PATH", "/nowhere:/proc"))  # fmt: skip
    case.variables |= dict([case.chance.choice(pairs)])


def variables(case: Case) -> None:
    """Variables of other programs."""
    pairs = (("COLUMNS", "abc"), ("COLUMNS", "0"), ("COLUMNS", "1"), ("COLUMNS", "60"), ("TERM", "nonsense"),
             ("MPLBACKEND", "bogus"), ("MPLCONFIGDIR", "/proc/nowhere"), ("SOFTRIG_JIT", "0"), ("CC", "/bin/false"),
             ("NUMBA_DISABLE_JIT", "1"), ("OMP_NUM_THREADS", "abc"), ("PYTHONOPTIMIZE", "2"), ("TZ", "Nowhere/None"),
             ("PYTHONWARNINGS", "error"), ("SOFTRIG_SCENARIOS", "/nowhere"), ("PYTHONHASHSEED", "7"), ("LANG", "xx"),
             ("SOFTRIG_COMMAND", "/nowhere"), ("NO_COLOR", "1"), ("PYTHONDEVMODE", "1"))  # fmt: skip
    case.variables |= dict([case.chance.choice(pairs)])


def homes(case: Case) -> None:
    """No home, an invalid home, or one that cannot be written."""
    case.variables.pop("XDG_CACHE_HOME", None)
    match case.chance.randrange(5):
        case 0:
            case.variables["HOME"] = "/proc/nowhere"
        case 1:
            case.variables.pop("HOME", None)
        case 2:
            case.variables["XDG_CACHE_HOME"] = "/dev/null"
        case 3:
            case.variables["HOME"] = ""
        case 4:
            (case.directory / "home").mkdir(mode=0o500)
            case.variables["HOME"] = str(case.directory / "home")
            case.before.append(powerless)


def temporaries(case: Case) -> None:
    """No folder for temporary files."""
    case.variables["TMPDIR"] = case.chance.choice(("/nowhere", "/dev/null", "/proc", "\n"))


def powerless() -> None:
    """Let permissions apply to root too."""
    library = ctypes.CDLL(None)
    for capability in (1, 2):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
        library.prctl(24, capability, 0, 0, 0)


def unwritable(case: Case) -> None:
    """A current directory or output that cannot be written."""
    match case.chance.randrange(3):
        case 0:
            case.before += [powerless, lambda: case.work.chmod(0o500)]
        case 1:
            case.out.write_text("a file")
        case 2:
            case.command = ["/proc/nowhere" if word == "out" else word for word in case.command]


def read_only(case: Case) -> None:
    """A checkout on a read-only file system."""
    case.prefix = mounted(f"mount --bind {ROOT} {ROOT} && mount -o remount,ro,bind {ROOT}")


def small_disk(case: Case) -> None:
    """An output on a file system that is soon full, or files that may not grow."""
    if case.chance.random() < 0.5:
        limit = case.chance.choice((1 << 10, 1 << 13, 1 << 16, 1 << 18))
        case.before.append(lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)))
        case.before.append(lambda: signal.signal(signal.SIGXFSZ, signal.SIG_IGN))
    else:
        case.out.mkdir()
        case.prefix = mounted(f"mount -t tmpfs -o size={case.chance.choice((4, 20, 60, 200))}k tmpfs {case.out}")


def mounted(mount: str) -> list[str]:
    """Return the beginning of a command line that mounts something only for the command; empty without the right to
    mount.
    """
    with suppress(OSError):
        for how in (["unshare", "-m"], ["unshare", "-Urm"]):
            if subprocess.run([*how, "sh", "-c", mount], capture_output=True).returncode == 0:
                return [*how, "sh", "-c", f'{mount} && exec "$@"', "sh"]
    return []


def small_memory(case: Case) -> None:
    """Little address space."""
    limit = case.chance.choice((100, 300, 600, 1000, 1500, 2500)) << 20
    case.any_status = True
    case.before.append(lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)))


def few_files(case: Case) -> None:
    """Few open files."""
    limit = case.chance.choice((8, 16, 32, 64))
    case.any_status = limit < 32
    case.before.append(lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit)))


def umasks(case: Case) -> None:
    """An odd umask."""
    mask = case.chance.choice((0o777, 0o000, 0o277, 0o177))
    case.before.append(lambda: os.umask(mask))
    if case.chance.random() < 0.5:
        case.before.append(powerless)


def lost_directory(case: Case) -> None:
    """A current directory that has been removed."""
    removed = case.directory / "gone"
    removed.mkdir()
    case.before.append(lambda: (os.chdir(removed), removed.rmdir()))


def signals(case: Case) -> None:
    """Signals ignored by the parent process, as nohup, cron and some shells do."""
    number = case.chance.choice((signal.SIGCHLD, signal.SIGINT, signal.SIGHUP, signal.SIGTERM))
    case.before.append(lambda: signal.signal(number, signal.SIG_IGN))


def names(case: Case) -> None:
    """Names that are not text."""
    case.command = [os.fsdecode(b"o\xffut") if word == "out" else word for word in case.command]


def terminals(case: Case) -> None:
    """A terminal, narrow or of an unknown kind."""
    _, line = pty.openpty()
    case.variables |= {"TERM": case.chance.choice(("", "dumb", "nonsense", "xterm")), "COLUMNS": "60"}
    case.variables.pop(case.chance.choice(("TERM", "COLUMNS", "none")), None)
    case.stderr = line
    if case.chance.random() < 0.5:
        case.stdout = line


STRANGE = (encodings, closed, full_output, gone_reader, domains, middlewares, ros_variables, variables, homes,
           temporaries, unwritable, read_only, small_disk, small_memory, few_files, umasks, lost_directory, signals,
           names, terminals)  # fmt: skip


def attack(seed: int, directory: Path) -> None:
    """Run one command in an environment with one or two things wrong."""
    chance = random.Random(seed)
    case = Case(directory, chance, commands(chance), dict(os.environ))
    case.work.mkdir()
    wrong = chance.sample(STRANGE, chance.choice((1, 1, 2)))
    for make in wrong:
        make(case)
    short = (
        [str(ROOT / "scripts/softrig")] if chance.random() < 0.2 else [sys.executable, "-P", "-m", "softrig_bringup"]
    )
    command = [*case.prefix, *short, *case.command]
    about = f"{', '.join(f.__name__ for f in wrong)}: {' '.join(command)}"
    (directory / "case").write_text(ascii(about) + "\n")
    status, text = run(case, command)
    (directory / "said").write_text(text)
    case.work.chmod(0o700)
    judge(case, status, text)


def run(case: Case, command: list[str]) -> tuple[int, str]:
    """Run the command; return its status and what it printed into files."""

    def before() -> None:
        for step in case.before:
            step()

    with (case.directory / "stdout").open("w+b") as out, (case.directory / "stderr").open("w+b") as err:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=out if case.stdout is None else case.stdout,
            stderr=err if case.stderr is None else case.stderr, cwd=case.work, env=case.variables, preexec_fn=before,
            start_new_session=True)  # fmt: skip
        for number in {case.stdout, case.stderr} - {None}:
            os.close(number)
        endless = case.command[0] == "node" or case.command[:2] == ["bag", "record"]
        deadline = time.monotonic() + LIMIT
        stop = time.monotonic() + 4.0 if endless else deadline
        try:
            while process.poll() is None:
                if time.monotonic() > stop:
                    process.send_signal(signal.SIGINT if time.monotonic() < deadline - 20 else signal.SIGTERM)
                    stop += 10.0
                assert time.monotonic() < deadline, "it does not end"
                time.sleep(0.05)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        out.seek(0)
        err.seek(0)
        return process.returncode, (out.read() + err.read()).decode(errors="replace")


def judge(case: Case, status: int, text: str) -> None:
    """Compare the result with what is allowed."""
    assert (left := orphans(case.directory)) == [], f"{len(left)} processes live on"
    allowed = {"out", "tables", "report.html", "runs", os.fsdecode(b"o\xffut")}
    remaining = {p.name for p in case.work.iterdir() if not p.name.endswith(".hprof")}
    assert remaining <= allowed, f"it wrote {sorted(remaining - allowed)} into the current directory"
    if case.any_status:
        return
    assert status in STATUSES, f"status {status}: {text[-800:]}"
    for word in SILENT:
        assert word not in text, text[-1500:]
    if status in (2, 3) and case.stderr is None and (case.directory / "stderr").stat().st_size == 0:
        assert closed_error(case), f"status {status} without a word"
    if status == 0 and case.command[0] == "run" and not case.prefix:
        assert main_compare([str(sound() / "bag"), str(case.out / "bag"), "--bitwise"]) == 0, "other bits"


def closed_error(case: Case) -> bool:
    """Return whether no reader could have received the output."""
    return any(step.__qualname__.startswith("closed.") for step in case.before)


if __name__ == "__main__":
    for number in map(int, sys.argv[1:]):
        place = Path(mkdtemp())
        attack(number, place)
        print((place / "case").read_text(), (place / "said").read_text()[-500:])
        shutil.rmtree(place)
