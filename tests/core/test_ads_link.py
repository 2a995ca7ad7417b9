"""A node on a PLC: the printed program executed behind a network that tears copies, and pyads with its own server."""

import random
import struct
from dataclasses import replace
from functools import cache

import pytest
from conftest import until
from plc_by_hand import Net, Plc
from softrig_core import ScenarioError, rig_of, simulate
from softrig_core.board.ads_line import AdsLine, program_of
from softrig_core.board.entry import LinkEntry
from softrig_core.board.frames import Kind
from softrig_core.board.layout import Layout
from softrig_core.board.line import Build
from softrig_core.errors import RunError
from softrig_core.export.golden import member_of
from softrig_core.export.st_files import st_of
from softrig_core.firmware.ads_files import main
from softrig_core.scenario.scenario import merge, read_draft

SCENARIO, NODE = "dc_motor_smc_b2", "dc_motor_smc"
CALLS, MANY = 1_000, 30_000


@cache
def law():
    rig = rig_of(SCENARIO)
    return member_of(rig, NODE), tuple(st_of(rig, NODE, rows=5, drawn=2)[0])


@cache
def layout():
    member, _ = law()
    return Layout(member.inputs, member.outputs, {}, plant=False, single=False)


def total(own):
    """A program whose answer shows each request that it has received."""

    def work(request, answer):
        if request.first:
            own["sum"] = 0.0
        own["sum"] += request.state_shaft_velocity
        answer.command_armature_effort = own["sum"]
        return False

    return work


def line_of(net, digest=None, timeout=0.05):
    build = Build(digest or net.plc.digest, (1, 100), layout())
    return AdsLine("ads:test", net.opened, build, timeout, net.now, net.sleep)


def request(k, velocity):
    return layout().step.pack(k, velocity, 0.0, 0.0, True, 0.0)


def command(answer):
    return layout().outputs_of(layout().answer.unpack(answer))["command"][0]


# on a network that loses and tears ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("calls", "seed"), [(CALLS, 1), pytest.param(MANY, 2, marks=pytest.mark.long)])
def test_no_lost_or_torn_copy_gives_a_wrong_answer_in_lockstep(calls, seed):
    rng = random.Random(seed)
    net = Net(Plc(law()[0], work=total({})), rng, 0.3, pulled=0.001)
    line = line_of(net)
    while line.counts.sent < calls:
        line.begin(b"")
        want = 0.0
        for k in range(40):
            u = float(rng.randrange(-4, 5))
            want += u
            assert command(line.ask(Kind.STEP, request(k, u))) == want
    assert min(net.happened.values()) > 0
    assert min(line.counts.repeated, line.counts.damaged, line.counts.reopened) > 0


@pytest.mark.parametrize(("calls", "seed"), [(CALLS, 3), pytest.param(MANY, 4, marks=pytest.mark.long)])
def test_real_time_accepts_the_answer_to_its_tick_or_none(calls, seed):
    def work(request, answer):
        answer.command_armature_effort = request.state_shaft_velocity
        return False

    rng = random.Random(seed)
    net = Net(Plc(law()[0], work=work), rng, 0.3, pulled=0.005)
    line, used = line_of(net), 0
    while line.counts.sent < calls:
        begun, u = net.time, rng.random()
        answer = line.try_ask(Kind.STEP, request(0, u), 0.003)
        assert net.time - begun < 0.015  # at most the time limit and one blocking call beyond it
        net.time = max(net.time, begun + 0.01)
        if rng.random() < 0.005:
            net.plc.power()
        if answer is not None:
            used += 1
            assert command(answer) == u
    assert used > calls / 3
    assert min(line.counts.lost, line.counts.rejoined, line.counts.reopened, line.counts.damaged) > 0


def test_a_plc_that_restarts_ends_a_lockstep_run():
    net = Net(Plc(law()[0], work=total({})), random.Random(0))
    line = line_of(net)
    line.ask(Kind.STEP, request(0, 1.0))
    net.plc.power()
    with pytest.raises(RunError, match=r"no answer of ads:test within .* it may have restarted"):
        line.ask(Kind.STEP, request(1, 1.0))


def test_another_build_is_refused_by_name():
    net = Net(Plc(law()[0], work=total({})), random.Random(0))
    with pytest.raises(RunError, match=f"has build '{net.plc.digest}', expected '00000000'"):
        line_of(net, digest="00000000").ask(Kind.STEP, request(0, 1.0))


def test_a_second_rig_at_one_program_gets_no_answer_of_the_first():
    plc = Plc(law()[0], work=total({}))
    nets = [Net(plc, random.Random(k)) for k in range(2)]
    first, second = map(line_of, nets)
    first.ask(Kind.STEP, request(0, 1.0))
    second.ask(Kind.STEP, request(0, 5.0))
    with pytest.raises(RunError, match="another program writes to it"):
        first.ask(Kind.STEP, request(1, 1.0))
    assert first.counts.strays > 0


def test_a_number_that_is_not_finite_is_not_an_answer():
    def work(request, answer):
        answer.command_armature_effort = float("nan")
        return False

    line = line_of(Net(Plc(law()[0], work=work), random.Random(0)))
    answers = []
    # The first answers arrive when the link is open.
    until(lambda: answers.append(line.try_ask(Kind.STEP, request(0, 1.0), 0.005)) or line.counts.damaged)
    assert set(answers) == {None}
    assert (line.counts.damaged, line.counts.lost) == (1, 1)


def test_a_missing_plc_ends_a_lockstep_run_with_its_reason():
    net = Net(Plc(law()[0], work=total({})), random.Random(0))
    net.back = 1e9
    with pytest.raises(RunError, match="the PLC ads:test cannot be reached: no route to host"):
        line_of(net).ask(Kind.STEP, request(0, 1.0))


# in a rig -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def exported(tmp_path, capsys):
    assert main([SCENARIO, NODE, "--out", str(tmp_path)]) == 0
    assert "calls FB_dc_motor_smc" in capsys.readouterr().out
    return tmp_path / "dc_motor_smc_link.TcPOU"


def linked_rig(file, port, **more):
    link = {"port": port, "firmware": str(file)} | more
    draft = read_draft(SCENARIO)
    return rig_of(replace(draft, raw=merge(draft.raw, {"nodes": {NODE: {"link": link}}})), duration=0.3)


class Served:
    """The PLC behind pyads' own server."""

    def __init__(self, host):
        from pyads.testserver import AdsTestServer, AdvancedHandler, PLCVariable

        self.plc = Plc(law()[0], law()[1])
        served = self

        class Variable(PLCVariable):
            @property
            def value(self):
                size = served.plc.formats[0].size
                known = {"request": lambda: bytes(size), "answer": served.plc.cycle}
                return known.get(self.name.split(".")[1], lambda: served.plc.digest.encode().ljust(17, b"\0"))()

            @value.setter
            def value(self, data):
                if len(data) == served.plc.formats[0].size and any(data):
                    served.plc.take(data)

        handler = AdvancedHandler()
        for name in ("request", "answer", "build"):
            handler.add_variable(Variable(f"dc_motor_smc_link.{name}", bytes(1), 65, "BYTE"))
        self.server = AdsTestServer(handler, ip_address=host, logging=False)

    def __enter__(self):
        self.server.start()
        return self

    def __exit__(self, *_):
        self.server.close()


def test_a_controller_on_a_plc_over_ads_has_the_same_bits_as_without(exported):
    pytest.importorskip("pyads", reason="needs pyads (scripts/softrig setup hardware)")
    host = "127.0.0.71"
    with Served(host):
        results = [simulate(linked_rig(exported, f"ads:{host}.1.1/851")).signals for _ in range(2)]
    plain = simulate(rig_of(SCENARIO, duration=0.3)).signals
    for name in ("motor/state/shaft/velocity", "motor/command/armature/effort"):
        assert list(results[0][name].x) == list(plain[name].x)
        assert list(results[1][name].x) == list(plain[name].x)


def test_an_answer_that_is_too_short_ends_a_run_in_one_line(exported):
    pytest.importorskip("pyads", reason="needs pyads (scripts/softrig setup hardware)")
    host = "127.0.0.73"
    with Served(host) as served:
        served.plc.cycle = lambda: b"short"
        with pytest.raises(RunError, match=r"the PLC ads:127\.0\.0\.73"):
            simulate(linked_rig(exported, f"ads:{host}.1.1/851", timeout=0.05))


def test_a_plc_that_is_off_ends_a_run_in_one_line(exported):
    pytest.importorskip("pyads", reason="needs pyads (scripts/softrig setup hardware)")
    with pytest.raises(RunError, match="cannot be reached: Connection refused"):
        simulate(linked_rig(exported, "ads:127.0.0.72.1.1/851", timeout=0.01))


@pytest.mark.parametrize("port", ["", "\n", "1.2.3.4/851", "1.2.3.4.1.1", "1.2.3.4.1.300/851", "1.2.3.4.1.1/x"])
def test_an_invalid_port_is_refused(port):
    with pytest.raises(ValueError, match=r"expected (ads:NETID/PORT|a name without control)"):
        LinkEntry(port=f"ads:{port}", firmware="f")


def test_a_file_that_is_not_a_program_or_has_other_parameters_is_refused(exported, tmp_path):
    (tmp_path / "bad.TcPOU").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ScenarioError, match=r"bad.TcPOU is no NODE_link.TcPOU"):
        program_of(tmp_path / "bad.TcPOU")
    with pytest.raises(ScenarioError, match="No such file"):
        program_of(tmp_path / "none.TcPOU")
    draft = read_draft(SCENARIO)
    link = {"port": "ads:127.0.0.1.1.1/851", "firmware": str(exported)}
    nodes = {NODE: {"link": link, "parameters": {"period": 0.02}}}
    with pytest.raises(ScenarioError, match="of another block or of other parameters of dc_motor_smc"):
        simulate(rig_of(replace(draft, raw=merge(draft.raw, {"nodes": nodes})), duration=0.5))


def test_structs_are_those_that_softrig_reads_and_writes():
    for scenario, node in ((SCENARIO, NODE), (SCENARIO, "dc_motor_plant"), ("dc_motor_fsfb", "fsfb_controller")):
        member = member_of(rig_of(scenario), node)
        plc, plant = Plc(member), member.is_plant
        frames = Layout(member.inputs, member.outputs, {}, plant, single=False)
        head, tail = struct.Struct("<II?"), struct.Struct("<I")
        assert plc.formats[0].size == head.size + frames.step.size + tail.size
        assert plc.formats[1].size == head.size - 1 + frames.answer.size + tail.size
        codes = plc.formats[0].format.removeprefix("<II?")
        assert codes.replace("?", "B") == plain(frames.step.format) + "I"


def plain(form):
    """Repeat the codes that a format counts."""
    result, count = "", ""
    for code in form.removeprefix("<"):
        if code.isdigit():
            count += code
        else:
            result, count = result + code * int(count or 1), ""
    return result
