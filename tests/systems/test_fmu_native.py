"""Nodes as FMUs without Python: the numbers of the block, bit for bit, checked with FMPy."""

import shutil

import pytest
from softrig_bringup.cli import main
from softrig_core import ByHand, rig_of
from softrig_core.export.golden import member_of

fmpy = pytest.importorskip("fmpy")
# ruff: noqa: E402
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler (Debian: apt-get install gcc)")
NODES = ("dc_motor_plant", "dc_motor_smc", "motor_reference")
COMMAND, SPEED = "motor.command.armature.effort", "motor.state.shaft.velocity"


@pytest.fixture(scope="module", params=[pytest.param(2, marks=pytest.mark.long), 3])
def exported(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(f"native{request.param}")
    words = ["export", "fmu", "dc_motor_smc", *NODES, "--native", "--fmi", str(request.param), "--out", str(folder)]
    assert main(words) == 0
    return folder, request.param


class Opened:
    """One instance of an FMU, by names."""

    def __init__(self, folder, version, node, start=0.0, **values):
        path = str(folder / f"{node}.fmu")
        self.about = fmpy.read_model_description(path)
        self.numbers = {v.name: v.valueReference for v in self.about.modelVariables}
        self.version = version
        kind = {2: FMU2Slave, 3: FMU3Slave}[version]
        self.fmu = kind(
            guid=self.about.guid,
            unzipDirectory=fmpy.extract(path),
            modelIdentifier=self.about.coSimulation.modelIdentifier,
            instanceName=node,
        )
        self.fmu.instantiate()
        self.set(**values)
        if version == 2:
            self.fmu.setupExperiment(startTime=start)
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(startTime=start)
        self.fmu.exitInitializationMode()
        self.t, self.period = start, float(self.about.defaultExperiment.stepSize)

    def set(self, **values):
        for name, value in values.items():
            put = self.fmu.setReal if self.version == 2 else self.fmu.setFloat64
            put([self.numbers[name.replace("__", ".")]], [value])

    def get(self, name):
        accept = self.fmu.getReal if self.version == 2 else self.fmu.getFloat64
        return accept([self.numbers[name]])[0]

    def step(self, count=1):
        self.fmu.doStep(currentCommunicationPoint=self.t, communicationStepSize=count * self.period)
        self.t += count * self.period

    def kept(self):
        return self.fmu.getFMUstate() if self.version == 2 else self.fmu.getFMUState()

    def bytes_of(self, state):
        return self.fmu.serializeFMUstate(state) if self.version == 2 else self.fmu.serializeFMUState(state)

    def back(self, data):
        if self.version == 2:
            self.fmu.setFMUstate(self.fmu.deSerializeFMUstate(data))
        else:
            self.fmu.setFMUState(self.fmu.deserializeFMUState(data))


def by_hand(node):
    block = member_of(rig_of("dc_motor_smc"), node).block(1)
    return ByHand(block)


@pytest.mark.long
def test_fmpy_finds_no_fault_and_simulates_the_bits_of_the_plant(exported):
    folder, _ = exported
    for node in NODES:
        assert validate_fmu(str(folder / f"{node}.fmu")) == []
    path = str(folder / "dc_motor_plant.fmu")
    h = float(fmpy.read_model_description(path).defaultExperiment.stepSize)
    result = fmpy.simulate_fmu(
        path, stop_time=100 * h, step_size=h, output_interval=h, start_values={COMMAND: 3.0}, output=[SPEED]
    )
    plant, expected = by_hand("dc_motor_plant"), []
    for k in range(101):
        expected.append(plant.outputs(round(k * h * 1e9))["state"][1])
        plant.advance(round(k * h * 1e9), command=(3.0,))
    assert result[SPEED].tolist() == expected
    assert expected[-1] > 0.001


def test_a_loop_of_two_models_and_a_second_instance_of_each_run(exported):
    folder, version = exported
    plants = [Opened(folder, version, "dc_motor_plant") for _ in range(2)]
    laws = [Opened(folder, version, "dc_motor_smc") for _ in range(2)]
    for k in range(50):
        for which in (0, 1):
            if which and k % 2:
                continue  # the second loop runs half as often
            plant, law = plants[which], laws[which]
            for name in law.numbers.keys() & plant.numbers.keys() - {COMMAND, "time"}:
                law.set(**{name: plant.get(name)})
            law.set(**{"motor.reference.shaft.velocity": 1.0})
            law.step()
            plant.set(**{COMMAND: law.get(COMMAND)})
            plant.step()
    assert plants[0].get(SPEED) != plants[1].get(SPEED)
    again = Opened(folder, version, "dc_motor_plant")
    block, law = by_hand("dc_motor_plant"), by_hand("dc_motor_smc")
    for k in range(50):
        t = round(k * again.period * 1e9)
        outputs = block.outputs(t)
        command = law.update(t, state=outputs["state"][1:2], sensors=outputs["sensors"], reference=(1.0,))["command"]
        block.advance(t, command=command)
    assert plants[0].get(SPEED) == block.outputs(0)["state"][1]


def test_a_state_is_saved_and_restored_in_another_instance(exported):
    folder, version = exported
    one = Opened(folder, version, "dc_motor_plant", **{COMMAND: 3.0})
    one.step(10)
    data = one.bytes_of(one.kept())
    one.step(5)
    other = Opened(folder, version, "dc_motor_plant")
    other.back(data)
    other.t = 10 * other.period
    other.step(5)
    assert other.get(SPEED) == one.get(SPEED) > 0.0
    with pytest.raises(FMICallException):
        other.back(data[:-1])
    with pytest.raises(FMICallException):
        other.back(bytes(8) + data[8:])


def test_a_start_time_is_the_time_of_the_first_tick(exported):
    folder, version = exported
    source, late = (Opened(folder, version, "motor_reference", start=at) for at in (0.0, 100.0))
    block = by_hand("motor_reference")
    name = "motor.reference.shaft.velocity"
    assert source.get(name) == block.update(0)["reference"][0]
    assert late.get(name) == block.update(100 * 10**9)["reference"][0]
    with pytest.raises(FMICallException):
        Opened(folder, version, "motor_reference", start=0.3 * late.period)


def test_an_unsupported_operation_is_an_error_that_changes_nothing(exported):
    folder, version = exported
    one = Opened(folder, version, "dc_motor_plant", **{COMMAND: 3.0})
    one.step(3)
    before = one.bytes_of(one.kept())
    for wrong in (1.5, 0.0, -1.0):
        with pytest.raises(FMICallException):
            one.fmu.doStep(currentCommunicationPoint=one.t, communicationStepSize=wrong * one.period)
    with pytest.raises(FMICallException):
        one.fmu.doStep(currentCommunicationPoint=7.0, communicationStepSize=one.period)
    with pytest.raises(FMICallException):
        one.set(vmax=5.0)  # a parameter cannot be set after the initialisation
    with pytest.raises(FMICallException):
        one.set(**{SPEED: 1.0})
    assert one.bytes_of(one.kept()) == before
    for wrong in (float("nan"), float("inf"), 1e8):
        one.set(**{COMMAND: wrong})
        with pytest.raises(FMICallException):
            one.step()
    one.set(**{COMMAND: 3.0})
    one.step()


def test_a_parameter_takes_effect_from_the_first_tick(exported):
    folder, version = exported
    one, other = (Opened(folder, version, "dc_motor_plant", **{COMMAND: 20.0}, **more) for more in ({}, {"vmax": 5.0}))
    one.step(20)
    other.step(20)
    assert 0.0 < other.get(SPEED) < one.get(SPEED)
    with pytest.raises(FMICallException):
        Opened(folder, version, "dc_motor_plant", vmax=-1.0)
