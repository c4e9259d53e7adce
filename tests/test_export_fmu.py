"""Functional mock-up units: the numbers of `simulate`, errors for flags, and what FMPy finds, where it is installed."""

import ctypes
import re
import subprocess
import xml.etree.ElementTree as ET
import zipfile

import jax.numpy as jnp
import numpy as np
import pytest
from compiled_c import STRICT, needs_compiler
from helpers import check_message
from zoo import PROBLEMS

import hhtjax
from hhtjax import export_fmu, hht

DT = 0.01
INPUTS = np.random.default_rng(0).normal(size=(50, 2))
PARAMS = {"k": 4.0, "u": hhtjax.sampled(INPUTS, dt=DT, order=0)}
SYSTEM = hhtjax.System(
    lambda q, p: jnp.array([[2.0 + q["x"][0] ** 2, 0.3], [0.3, 1.0]]),
    lambda q, v, t, p: {"x": -p["k"] * q["x"] + p["u"](t)},
)
Q0, V0 = {"x": jnp.array([0.1, 0.2])}, {"x": jnp.zeros(2)}
STEPPER = hht(-0.1)
UNITS = {"q": "m", "v": "m/s", "k": "N/m", "u": "N & more"}
NAMES: dict = {"dt": DT, "name": "driven", "sensitivities": ("k",), "units": UNITS}
OK, ERROR = 0, 3
LOGGER = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p)


@pytest.fixture(scope="module")
def unit():
    return export_fmu(SYSTEM, STEPPER, Q0, V0, PARAMS, **NAMES)


@pytest.fixture(scope="module")
def archive(unit, tmp_path_factory):
    return unit.write(tmp_path_factory.mktemp("unit"))


@pytest.fixture(scope="module")
def expected():
    return hhtjax.simulate(SYSTEM, STEPPER, Q0, V0, PARAMS, dt=DT, num_steps=50)


class Slave:
    """The binary, called as an importer does."""

    def __init__(self, archive, folder):
        with zipfile.ZipFile(archive) as files:
            (binary,) = [x for x in files.namelist() if x.startswith("binaries/")]
            files.extractall(folder)
            root = ET.fromstring(files.read("modelDescription.xml"))
        self.library = ctypes.CDLL(str(folder / binary))
        found = root.find("ModelVariables")
        assert found is not None
        self.references = {x.attrib["name"]: int(x.attrib["valueReference"]) for x in found}
        self.messages = []
        self.logger = LOGGER(lambda *args: self.messages.append(args[3].decode()))
        create = self.library.fmi3InstantiateCoSimulation
        create.restype = ctypes.c_void_p
        create.argtypes = [
            *(ctypes.c_char_p,) * 3, *(ctypes.c_bool,) * 4, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p,
            LOGGER, ctypes.c_void_p,
        ]  # fmt: skip
        self.create = lambda token: create(b"one", token, None, *(False,) * 4, None, 0, None, self.logger, None)
        self.instance = ctypes.c_void_p(self.create(root.attrib["instantiationToken"].encode()))

    def call(self, name, *args):
        return getattr(self.library, f"fmi3{name}")(self.instance, *args)

    def access(self, name, references, values):
        r = (ctypes.c_uint * len(references))(*(self.references[x] for x in references))
        return self.call(name, r, ctypes.c_size_t(len(r)), values, ctypes.c_size_t(len(r)))

    def get(self, *names):
        values = (ctypes.c_double * len(names))()
        assert self.access("GetFloat64", names, values) == OK
        return np.array(values)

    def set(self, **values):
        names = [re.sub(r"_at_(\d)", r"[\1]", x) for x in values]
        return self.access("SetFloat64", names, (ctypes.c_double * len(names))(*values.values()))

    def begin(self, t0=0.0):
        number = ctypes.c_double
        self.call("EnterInitializationMode", False, number(0), number(t0), False, number(0))
        return self.call("ExitInitializationMode")

    def step(self, t, h):
        flags, last = [ctypes.byref(ctypes.c_bool()) for _ in range(3)], ctypes.c_double()
        status = self.call("DoStep", ctypes.c_double(t), ctypes.c_double(h), True, *flags, ctypes.byref(last))
        return status, last.value


@pytest.fixture
def slave(archive, tmp_path):
    return Slave(archive, tmp_path)


def run(slave, first=0, last=50):
    for k in range(first, last):
        assert slave.set(u_at_1=INPUTS[k, 0], u_at_2=INPUTS[k, 1]) == OK
        status, t = slave.step(k * DT, DT)
        assert status == OK
        assert t == pytest.approx((k + 1) * DT, rel=1e-14)


@pytest.mark.slow
@needs_compiler
def test_a_unit_is_simulate(slave, expected):
    assert slave.begin() == OK
    run(slave)
    q, v = slave.get("q_x[1]", "q_x[2]"), slave.get("v_x[1]", "v_x[2]")
    assert q == pytest.approx(np.asarray(expected.q["x"][-1]), rel=1e-12)
    assert v == pytest.approx(np.asarray(expected.v["x"][-1]), rel=1e-12)
    assert np.all(abs(slave.get("dq_x_dk[1]", "dq_x_dk[2]")) > 1e-4)


@pytest.mark.slow
@needs_compiler
def test_variables_have_units(unit):
    root = ET.fromstring(unit.description)
    assert [x.tag for x in root][:2] == ["CoSimulation", "UnitDefinitions"]
    assert {x.attrib["name"] for x in root.iterfind("UnitDefinitions/Unit")} == set(UNITS.values())
    variables = root.find("ModelVariables")
    assert variables is not None
    found = {x.attrib["name"]: x.attrib.get("unit") for x in variables}
    expected = {"q_x[1]": "m", "q0_x[2]": "m", "v0_x[1]": "m/s", "k": "N/m", "u[2]": "N & more", "w_x[1]": None}
    assert {name: found[name] for name in expected} == expected
    assert "driven_real q_x[2]; /* m */" in unit.c.header
    assert "driven_real k; /* N/m */" in unit.c.header
    assert "u = u[2] (N & more) held over it" in unit.c.header


@pytest.mark.slow
def test_one_long_step_is_many_short_ones(slave):
    """With the input held, to the last bit; and of a step that is no multiple, steps a little shorter."""
    slave.begin()
    for k in range(10):
        slave.step(k * DT, DT)
    short = slave.get("q_x[1]", "v_x[2]")
    slave.call("Reset")
    slave.begin()
    assert slave.step(0.0, 10 * DT) == (OK, pytest.approx(0.1, rel=1e-14))
    assert np.array_equal(slave.get("q_x[1]", "v_x[2]"), short)
    assert slave.step(0.1, 2.5 * DT) == (OK, pytest.approx(0.125, rel=1e-14))


@pytest.mark.slow
@needs_compiler
def test_a_state_can_be_kept_and_parameters_tuned(slave, expected):
    slave.begin()
    run(slave, 0, 20)
    state, size = ctypes.c_void_p(), ctypes.c_size_t()
    assert slave.call("GetFMUState", ctypes.byref(state)) == OK
    assert slave.call("SerializedFMUStateSize", state, ctypes.byref(size)) == OK
    kept = (ctypes.c_ubyte * size.value)()
    assert slave.call("SerializeFMUState", state, kept, size) == OK
    assert slave.call("FreeFMUState", ctypes.byref(state)) == OK
    assert slave.set(k=40.0) == OK
    run(slave, 20, 50)
    assert abs(slave.get("q_x[1]")[0] - float(expected.q["x"][-1, 0])) > 1e-3
    assert slave.call("DeserializeFMUState", kept, size, ctypes.byref(state)) == OK
    assert slave.call("SetFMUState", state) == OK
    run(slave, 20, 50)
    assert slave.get("q_x[1]")[0] == pytest.approx(float(expected.q["x"][-1, 0]), rel=1e-12)
    slave.call("FreeFMUState", ctypes.byref(state))


@needs_compiler
def test_a_flag_is_an_error_and_so_is_what_is_not_there(slave):
    assert slave.set(k=float("nan")) == OK
    assert slave.begin() == ERROR
    assert "infinite or NaN" in slave.messages[-1]
    assert slave.step(0.0, DT)[0] == ERROR
    assert slave.call("Reset") == OK
    assert slave.begin() == OK
    assert slave.step(0.0, DT)[0] == OK
    assert slave.step(DT, -DT)[0] == ERROR
    assert slave.set(q_x_at_1=1.0) == ERROR  # an output
    assert slave.set(q0_x_at_1=1.0) == ERROR  # fixed, and the run has begun
    assert slave.set(k=float("inf")) == OK
    assert slave.step(DT, DT)[0] == ERROR
    assert slave.step(DT, DT)[0] == ERROR  # it stays
    one = (ctypes.c_uint * 1)(1)
    assert slave.call("GetInt32", one, ctypes.c_size_t(1), (ctypes.c_int * 1)(), ctypes.c_size_t(1)) == ERROR
    assert slave.create(b"another token") is None


@needs_compiler
def test_the_initial_values_can_be_set(slave):
    assert slave.set(q0_x_at_1=0.5, v0_x_at_2=-1.0) == OK
    assert list(slave.get("q_x[1]", "v_x[2]")) == [0.5, -1.0]
    assert slave.begin(t0=2.0) == OK
    assert slave.get("time")[0] == 2.0


@needs_compiler
def test_the_sources_compile_without_a_warning(unit, tmp_path):
    unit.c.write(tmp_path)
    (tmp_path / "fmi3.c").write_text(unit.wrapper)
    command = ["cc", *STRICT, "-c", "fmi3.c", "driven.c"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_the_same_model_is_the_same_unit(unit):
    again = export_fmu(SYSTEM, STEPPER, Q0, V0, PARAMS, **NAMES)
    assert again == unit
    other = export_fmu(SYSTEM, STEPPER, Q0, V0, PARAMS | {"k": 5.0}, dt=DT, name="driven", sensitivities=("k",))
    token = re.compile('instantiationToken="([^"]*)"')
    assert token.findall(other.description) != token.findall(unit.description)


def test_without_a_compiler_there_are_sources_and_a_warning(unit, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.warns(UserWarning, match="no C compiler found"):
        path = unit.write(tmp_path, progress=True)
    assert "export_fmu: compiling driven.c" in capsys.readouterr().err
    names = zipfile.ZipFile(path).namelist()
    assert "sources/driven.c" in names
    assert not [name for name in names if name.startswith("binaries/")]


def test_params_have_numbers_and_names_as_xml_has_them(capsys):
    """Infinity, and a name that an output has."""
    spring = hhtjax.System(jnp.ones(1), lambda q, v, t, p: -jnp.minimum(q, p["a"]) - p["time"])
    unit = export_fmu(spring, STEPPER, 1.0, 1.0, {"a": np.inf, "time": 2.0}, dt=DT, progress=True)
    assert "export_fmu: writing model_step" in capsys.readouterr().err
    starts = {x.attrib["name"]: x.attrib.get("start") for x in ET.fromstring(unit.description).iter("Float64")}
    outputs = dict.fromkeys(["time", "q", "v", "w", "a"])
    assert starts == outputs | {"q0": "1.0", "v0": "1.0", "a_2": "INF", "time_2": "2.0"}


def test_wrong_arguments_are_named():
    for dt in (0.0, float("nan")):
        check_message(
            ValueError, "export_fmu: `dt` must be", lambda dt=dt: export_fmu(SYSTEM, STEPPER, Q0, V0, PARAMS, dt=dt)
        )
    check_message(
        ValueError, "export_fmu: `name`", lambda: export_fmu(SYSTEM, STEPPER, Q0, V0, PARAMS, dt=DT, name="a b")
    )


@needs_compiler
def test_fmpy_finds_nothing_and_simulates(archive, tmp_path):
    """An independent importer: schemas, rules of the standard, and a run of the double pendulum."""
    fmpy = pytest.importorskip("fmpy", reason="FMPy is not installed: pip install hhtjax[fmu]")
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(archive)) == []
    problem = PROBLEMS["forced double pendulum"]
    path = export_fmu(
        problem.system, STEPPER, problem.q0, problem.v0, problem.params, dt=1e-3, name="two"
    ).write(tmp_path)  # fmt: skip
    assert validate_fmu(str(path)) == []
    result = fmpy.simulate_fmu(str(path), stop_time=1.0, output_interval=1e-2)
    run = hhtjax.simulate(
        problem.system, STEPPER, problem.q0, problem.v0, problem.params, dt=1e-3, num_steps=1000, save_every=10
    )
    assert len(result) == 101
    for i in (0, 1):
        ours = result[f"q[{i + 1}]"]
        assert np.max(abs(ours - run.q[:, i])) < 1e-12 * np.max(abs(run.q[:, i]))
