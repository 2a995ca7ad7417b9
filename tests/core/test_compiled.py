import math
import struct

import casadi as ca
import pytest
from softrig_core import Compiled
from softrig_core.kit import compiled


def pendulum(gain: float = 9.81) -> ca.Function:
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    return ca.Function("pendulum", [x, u], [ca.vertcat(x[1], -gain * ca.sin(x[0]) + u), x[0] * u])


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "softrig"


def test_compiled_equals_formula_and_virtual_machine(folder, monkeypatch):
    fast = Compiled(pendulum())
    monkeypatch.setattr(compiled, "build", lambda function: None)
    slow = Compiled(pendulum())
    assert fast.native
    assert not slow.native
    for k in range(50):
        x = (0.1 * k, 1.0 - 0.3 * k, 0.05 * k)
        expected = (x[1], -9.81 * math.sin(x[0]) + x[2], x[0] * x[2])
        assert fast(x) == slow(x)
        assert fast(x) == pytest.approx(expected, abs=1e-14)


def test_library_is_built_once_and_again_for_other_content(folder, monkeypatch):
    Compiled(pendulum())
    (library,) = folder.iterdir()
    date = library.stat().st_mtime_ns
    assert Compiled(pendulum()).native
    assert [p.stat().st_mtime_ns for p in folder.iterdir()] == [date]
    moon = Compiled(pendulum(1.62))
    assert len(list(folder.iterdir())) == 2
    assert moon((1.0, 0.0, 0.0))[1] == pytest.approx(-1.62 * math.sin(1.0))


def test_without_compiler_it_warns_and_still_gives_the_numbers(monkeypatch):
    monkeypatch.setenv("PATH", "/nonexistent")
    monkeypatch.delenv("CC", raising=False)
    with pytest.warns(UserWarning, match="no C compiler found: pendulum"):
        f = Compiled(pendulum())
    assert not f.native
    assert f((0.0, 2.0, 3.0)) == (2.0, 3.0, 0.0)


def test_failing_compiler_is_reported_with_its_message(folder, monkeypatch, tmp_path):
    broken = tmp_path / "cc"
    broken.write_text("#!/bin/sh\necho 'out of registers' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    with pytest.warns(UserWarning, match="could not compile pendulum .out of registers."):
        f = Compiled(pendulum())
    assert f((0.0, 2.0, 3.0)) == (2.0, 3.0, 0.0)
    assert list(folder.iterdir()) == []


def test_arithmetic_is_what_the_library_computes_with_the_same_bits():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    sums = ca.vertcat(x[1] / 3 - u, 2 * x[0] + 0.1, -x[0] * (x[1] * x[1]), 7)
    code = Compiled(ca.Function("sums", [x, u], [sums, u * 1e-9 / (x[0] - 0.7)]))
    assert code.arithmetic
    for k in range(50):
        values = 0.1 * k, 1.0 - 0.3 * k, 0.05 * k
        known = {f"v{n}": value for n, value in enumerate(values)}
        exec("\n".join(code.arithmetic), known)
        assert struct.pack("5d", *(known[f"r{n}"] for n in range(5))) == struct.pack("5d", *code(values))


def test_a_function_with_more_than_arithmetic_has_no_statements():
    x = ca.MX.sym("x", 2)
    assert Compiled(pendulum()).arithmetic == []
    assert Compiled(ca.Function("product", [x], [ca.dot(x, x)])).arithmetic == []


def test_wrong_use_is_refused():
    with pytest.raises(struct.error):
        Compiled(pendulum())((1.0, 2.0))
    x = ca.SX.sym("x", ca.Sparsity.diag(2))
    with pytest.raises(ValueError, match="input i0 of f is sparse"):
        Compiled(ca.Function("f", [x], [ca.sum1(ca.diag(x))]))


def test_a_call_of_another_thread_in_the_middle_changes_nothing():
    """Runs of one robot share their functions, also when a user's threads run them at the same time."""
    step, first, second = Compiled(pendulum()), (0.1, 1.0, 0.05), (0.7, -2.0, 3.0)
    alone, pack = {x: step(x) for x in (first, second)}, step._pack

    def interrupted(*arguments):
        pack(*arguments)
        step._pack = pack
        assert step(second) == alone[second]

    step._pack = interrupted
    assert step(first) == alone[first] != alone[second]
