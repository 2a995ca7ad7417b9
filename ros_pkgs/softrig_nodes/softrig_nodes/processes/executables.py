"""Executables of ROS packages: where they are, their environment, and how a process becomes one."""

from __future__ import annotations

import math
import os
import re
import sys
from os.path import isfile
from pathlib import Path

from softrig_core.bits import pin
from softrig_core.errors import ScenarioError, closest
from softrig_core.guard import replace
from softrig_core.kit.resource import prefixes
from softrig_core.needs import join_prefix
from softrig_core.rig.installed import load_main

PROFILE = Path(__file__).parent.with_name("fastdds_profile.xml")
LOOPBACK = PROFILE.with_name("fastdds_loopback.xml")  # the same for a process that other hosts must not reach
NETWORK = ("ROS_STATIC_PEERS", "ROS_DISCOVERY_SERVER")  # set only to reach other hosts
NO_MEMORY = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}  # Fast DDS's own variable; `ros.profile` follows it, too
MARGIN = 2  # s: an announcement in 0.5 s renews the lease; on a busy host it comes late


def find_executable(package: str, executable: str) -> Path:
    """Find ``lib/<package>/<executable>`` of a sourced workspace.

    Raises
    ------
    ScenarioError
        It is not there; lists what the package has.
    """
    installed = prefixes()
    for prefix in installed:
        path = prefix / "lib" / package / executable
        if isfile(path) and os.access(path, os.X_OK):
            return path
    names = sorted({p.name for prefix in installed for p in (prefix / "lib" / package).glob("*") if p.is_file()})
    if not names:
        packages = [folder.name for prefix in installed for folder in (prefix / "lib").glob("*") if folder.is_dir()]
        raise ScenarioError(
            f"package {package!r} has no executables here{closest(package, packages)}; one of your own "
            "is in the folder that --workspace DIR names before the verb"
        )
    raise ScenarioError(
        f"package {package} has no executable {executable!r}{closest(executable, names)}; it has {', '.join(names)}"
    )


def given_profile() -> Path:
    """Return the profile of this process: the one of its environment, or the default."""
    # The first name is that of Fast DDS 3, which still reads the second one but warns.
    names = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
    return Path(next(filter(None, map(os.environ.get, names)), default_profile()))


def default_profile() -> Path:
    """Return the profile of a process without its own; other hosts reach a process only if it asks for that."""
    asked = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") in ("SUBNET", "SYSTEM_DEFAULT")
    return PROFILE if asked or any(map(os.environ.get, NETWORK)) else LOOPBACK


def environment(
    domain: int, directory: Path, *, discovery: str = "LOCALHOST", silence: float | None = None
) -> dict[str, str]:
    """Return the environment of a node process: its domain, the range of its discovery, its logs in a directory.

    With `silence`, others consider it dead only after more than so many s; the profile for that is written there.
    """
    variables = dict(os.environ)
    pin(variables)
    join_prefix(variables)
    variables |= {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": discovery,
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "ROS_LOG_DIR": str(directory / "log"),
        "PYTHONUNBUFFERED": "1",
        # A BLAS with several threads splits sums by the number of cores, which would change the last bits.
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    # This deprecated variable would override the discovery range.
    variables.pop("ROS_LOCALHOST_ONLY", None)
    profile = LOOPBACK if discovery == "LOCALHOST" else PROFILE
    if not variables.get("FASTRTPS_DEFAULT_PROFILES_FILE"):
        chosen = profile if silence is None else patient(profile, directory, silence)
        variables["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(chosen)
    return variables


def patient(profile: Path, directory: Path, silence: float) -> Path:
    """Write a Fast DDS profile, ``profile.xml``, whose lease is longer than a given silence in seconds."""
    file = directory / "profile.xml"
    replace(file, leased(profile.read_text(), silence))
    return file


def leased(profile: str, silence: float) -> str:
    """Return the text of a profile with such a lease."""
    lease = f"<leaseDuration><sec>{math.ceil(silence) + MARGIN}</sec></leaseDuration>"
    return re.sub("<leaseDuration>.*</leaseDuration>", lease, profile)


def node_main(package: str, executable: str, arguments: list[str]) -> int:
    """Become an executable, as ``ros2 run`` does.

    A Python executable runs in this process, so that an error at the import of its module is reported with its place.
    Any other executable replaces this process.

    Raises
    ------
    ScenarioError
        No such executable, or its module cannot be imported.
    """
    path = find_executable(package, executable)
    os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(default_profile()))
    main = load_main(package, executable)
    # `execv` replaces the process without flushing Python's buffers.
    sys.stdout.flush()
    if main is None:
        os.execv(path, [str(path), *arguments])
    sys.argv = [str(path), *arguments]
    return int(main() or 0)
