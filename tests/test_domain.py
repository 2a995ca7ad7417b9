"""Reserving a DDS domain."""

import subprocess
import sys

import pytest
from softrig_core.errors import RunError
from softrig_core.rig import domain
from softrig_core.rig.domain import free_domain

HOLD = """
import sys
from softrig_core.rig.domain import free_domain
with free_domain() as d:
    print(d, flush=True)
    sys.stdin.readline()
"""


def test_two_reservations_differ_and_the_first_comes_free_again():
    with free_domain() as first:
        with free_domain() as second:
            assert first != second
        with free_domain() as again:
            assert again == second


def test_another_process_holds_its_domain_until_it_dies(monkeypatch):
    with subprocess.Popen([sys.executable, "-c", HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        theirs = int(child.stdout.readline())
        monkeypatch.setattr(domain, "DOMAINS", range(theirs, theirs + 1))
        with pytest.raises(RunError, match="in use"), free_domain():
            pass
        child.kill()
        child.wait()
    with free_domain() as ours:
        assert ours == theirs
