"""Packages that only some features need; the first use of a feature asks for its package.

A checkout installs an extra on first use and reports it in one line. Its set-up has the others already, but a package
of a ROS distribution cannot depend on them, because no distribution has them.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess

from .errors import ScenarioError

# the extra of pyproject.toml that brings a package
EXTRAS = {
    "pyarrow": "tables",
    "pandas": "frames",
    "optuna": "search",
    "cmaes": "search",
    "distributed": "dask",
    "bokeh": "view",
    "gymnasium": "learning",
    "sphinx": "docs",
    "myst_nb": "docs",
    "fmpy": "fmu",
    "pythonfmu": "fmu",
    "serial": "hardware",
    "can": "hardware",
    "cantools": "hardware",
    "pyads": "hardware",
}


OF_PIP = ("casadi", "control", "sentil", "pycparser", "mcap", "lz4", "backports.zstd")


def need(package: str, user: str) -> None:
    """Install a package if it cannot be imported.

    Parameters
    ----------
    package : str
        One of `EXTRAS` or `OF_PIP`.
    user : str
        The feature that needs it, as named in the error.

    Raises
    ------
    ScenarioError
        The package is missing and could not be installed; the message explains how to install it.
    """
    if _is_installed(package):
        return
    if package in OF_PIP:
        raise ScenarioError(f"{user} needs the package {package!r}: pip install {package}")
    extra = EXTRAS[package]
    if command := os.environ.get("SOFTRIG_COMMAND"):
        subprocess.run([command, "setup", extra], stdin=subprocess.DEVNULL, check=False)  # prints its own lines
        importlib.invalidate_caches()
        if _is_installed(package):
            return
        raise ScenarioError(f"{user} needs the package {package!r}: {command} setup {extra} (see above why it failed)")
    raise ScenarioError(f"{user} needs the package {package!r}: pip install 'softrig[{extra}]', or {package} by itself")


def _is_installed(package: str) -> bool:
    try:
        return importlib.util.find_spec(package) is not None
    except ModuleNotFoundError:  # of the namespace that it is in
        return False
