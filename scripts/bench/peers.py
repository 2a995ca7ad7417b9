"""Simulators of others, in a Python that has them."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

_OURS = ("PYTHONPATH", "LD_LIBRARY_PATH", "VIRTUAL_ENV", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")  # not for another Python


def asked(script: str, name: str, given: Any, python: str, *arguments: str) -> Any:
    """Return the output of a module beside this one under another Python; None if that lacks the simulator.

    Parameters
    ----------
    script : str
        The module's name.
    name : str
        Of the simulator, for errors.
    given : any
        Plain data, handed over as JSON.

    Raises
    ------
    RuntimeError
        It fails; with the last line of what it says.
    """
    done = subprocess.run(
        [python, str(Path(__file__).with_name(f"{script}.py")), *arguments],
        input=json.dumps(given),
        text=True,
        capture_output=True,
        env={k: v for k, v in os.environ.items() if k not in _OURS},
        check=False,
    )
    if done.returncode and "ModuleNotFoundError" in done.stderr:
        return None
    if done.returncode:
        raise RuntimeError(f"{name}: {done.stderr.strip().splitlines()[-1]}")
    return json.loads(done.stdout)
