"""Export of a system, a stepper and parameters as a functional mock-up unit: FMI 3.0, Co-Simulation."""

import hashlib
import platform
import re
import shutil
import subprocess
import tempfile
import warnings
import zipfile
from dataclasses import dataclass
from dataclasses import field as entry
from functools import partial
from itertools import chain
from pathlib import Path
from xml.sax.saxutils import quoteattr

import jax
import numpy as np

from hhtjax.checks import require_number
from hhtjax.description import VERSION, PyTree, Real
from hhtjax.export.export_c import ExportedC, exported
from hhtjax.export.fmi3 import wrapper
from hhtjax.export.model import distinct, fields
from hhtjax.export.statements import number
from hhtjax.runs.progress import stages
from hhtjax.steppers.stepper import Stepper
from hhtjax.systems.system import AnySystem

FLAGS = "-std=c99", "-O3", "-fPIC", "-shared", "-fvisibility=hidden"
EPOCH = 1980, 1, 1, 0, 0, 0  # of every file in the archive, so that the same model is the same archive
DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName={model} instantiationToken="{token}" generationTool="hhtjax {version}"
    variableNamingConvention="structured">
  <CoSimulation modelIdentifier={model} canHandleVariableCommunicationStepSize="true" canGetAndSetFMUState="true"
      canSerializeFMUState="true" fixedInternalStepSize="{dt}"/>{units}
  <LogCategories>
    <Category name="logStatusError"/>
  </LogCategories>
  <DefaultExperiment startTime="0" stepSize="{dt}"/>
  <ModelVariables>
{variables}
  </ModelVariables>
  <ModelStructure>
{structure}
  </ModelStructure>
</fmiModelDescription>
"""
BUILD = """<?xml version="1.0" encoding="UTF-8"?>
<fmiBuildDescription fmiVersion="3.0">
  <BuildConfiguration modelIdentifier={model}>
    <SourceFileSet language="C99">
      <SourceFile name="fmi3.c"/>
      <SourceFile name="{name}.c"/>
    </SourceFileSet>
    <Library name="m" external="true"/>
  </BuildConfiguration>
</fmiBuildDescription>
"""


@dataclass(frozen=True)
class ExportedFMU:
    """A functional mock-up unit, made by `export_fmu`.

    Attributes:
        c: the model in C, an `ExportedC`.
        description: the text of modelDescription.xml.
        wrapper: the text of sources/fmi3.c, which contains the functions of FMI.
    """

    c: ExportedC
    description: str = entry(repr=False)
    wrapper: str = entry(repr=False)

    def write(self, folder, progress: bool = False) -> Path:
        """Writes name.fmu into a folder, with sources and a binary for this platform. Returns its path.

        Without a C compiler (cc, gcc or clang) it warns, and the unit contains only the sources.

        progress: shows in one line on stderr that the sources are being compiled.
        """
        folder, name = Path(folder), self.c.name
        folder.mkdir(parents=True, exist_ok=True)
        build = BUILD.format(model=quoteattr(name), name=name)
        files: dict[str, str | bytes] = {
            "modelDescription.xml": self.description, "sources/fmi3.c": self.wrapper,
            f"sources/{name}.c": self.c.source, f"sources/{name}.h": self.c.header,
            "sources/buildDescription.xml": build,
        }  # fmt: skip
        system = platform.system().lower()
        with stages("export_fmu", progress) as tell:
            tell(f"compiling {name}.c")
            binary = _binary(name, {path: str(text) for path, text in files.items()})
        if binary is None:
            warnings.warn(f"export_fmu: no C compiler found: {name}.fmu contains sources, but no binary.", stacklevel=2)
        else:
            ending = {"darwin": "dylib", "windows": "dll"}.get(system, "so")
            machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
            files[f"binaries/{machine}-{system}/{name}.{ending}"] = binary
        path = folder / f"{name}.fmu"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for where, content in files.items():
                archive.writestr(zipfile.ZipInfo(where, EPOCH), content, zipfile.ZIP_DEFLATED)
        return path


def _binary(name, files):
    """The shared library compiled from the sources; None without a compiler."""
    compiler = next((x for x in ("cc", "gcc", "clang") if shutil.which(x)), None)
    if compiler is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        for path, text in files.items():
            (Path(folder) / Path(path).name).write_text(text)
        command = [compiler, *FLAGS, "fmi3.c", f"{name}.c", "-o", "binary", "-lm"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        return (Path(folder) / "binary").read_bytes()


def export_fmu(
    system: AnySystem, stepper: Stepper, q0: PyTree, v0: PyTree = None, params: PyTree = None, *,
    z0: PyTree = None, dt: Real, name: str = "model", sensitivities: tuple = (), units: dict | None = None,
    progress: bool = False,
) -> ExportedFMU:  # fmt: skip
    """Exports a system as a functional mock-up unit (FMI 3.0, Co-Simulation), for Simulink, OpenModelica, Dymola, ...

    Variables of the unit:

        outputs               the fields of the state of `export_c` (q, v, w, ..., and derivatives)
        tunable parameters    the floating numbers of params
        fixed parameters      the initial values (q0, v0, z0)
        inputs                each `sampled` of params, constant during a step

    If a name is already used by another variable, a number is added: if the outputs include a, a parameter a becomes
    a_2.

    A communication step is divided into steps of dt. If it is not a multiple of dt, the steps are a little shorter. If
    a step sets a flag, the unit returns fmi3Error. To go on, call `fmi3Reset` or restore an earlier state.

    Args:
        system, stepper, q0, v0, params, z0, name, sensitivities, units, progress: as in `export_c`.
        dt: step size, s.

    Returns:
        An `ExportedFMU`; its `write(folder)` compiles it and writes name.fmu.

    Raises:
        NotImplementedError, ValueError, TypeError: as `export_c`; dt is not positive.

    References:
        Modelica Association, Functional Mock-up Interface Specification 3.0 (2022).

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, p: -p["k"] * q)
    >>> unit = hhtjax.export_fmu(spring, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), {"k": 4.0}, dt=1e-3, name="spring")
    >>> print(next(line.strip() for line in unit.description.splitlines() if 'name="k"' in line))
    <Float64 name="k" valueReference="7" causality="parameter" variability="tunable" start="4.0"/>
    """
    require_number("export_fmu", "dt", dt, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    with stages("export_fmu", progress) as tell:
        c = exported("export_fmu", system, stepper, q0, v0, params, z0, name, sensitivities, units, tell)
    starts = [(key, x) for key, x in (("q0", q0), ("v0", v0), ("z0", z0)) if x is not None]
    begin = [field for key, x in starts for field in fields(x, key, key)]
    begin_units = {field.name: c.units.get(re.sub("^([qvz])0", r"\1", field.name)) for field in begin}
    values = [float(x) for _, tree in starts for leaf in jax.tree.leaves(tree) for x in np.ravel(leaf)]
    single = f"typedef float {name}_real;" in c.header
    kind, dtype = ("Float32", np.float32) if single else ("Float64", np.float64)
    step = repr(float(dt))
    state, begin, params, inputs = _named(c.state, begin, c.params, c.inputs)
    variables = partial(_variables, kind)
    groups = [
        variables(state, "m->s.", 'causality="output" variability="continuous"', None, c.units),
        variables(begin, None, 'causality="parameter" variability="fixed"', values, begin_units, "m->start"),
        variables(params, "m->p.", 'causality="parameter" variability="tunable"', c.values, c.units),
        variables(inputs, None, 'causality="input" variability="discrete"', c.input_values, c.units, "m->u"),
    ]
    first, places, lines = 1, ["m->s.t"], []
    ranges = []
    for label, group in zip(("OUTPUT", "START", "PARAM", "INPUT"), groups, strict=True):
        ranges.append(f"FIRST_{label} = {first}")
        lines += [text.format(reference=first + i) for i, (text, _) in enumerate(group)]
        places += [place for _, place in group]
        first += len(group)
    time = f'    <{kind} name="time" valueReference="0" causality="independent" variability="continuous"/>'
    outputs = range(1, 1 + len(groups[0]))
    structure = [f'    <{tag} valueReference="{i}"/>' for tag in ("Output", "InitialUnknown") for i in outputs]
    token = hashlib.sha256("\n".join([c.header, c.source, *lines, step]).encode()).hexdigest()[:32]
    description = DESCRIPTION.format(
        model=quoteattr(name), token=token, version=VERSION, dt=step, variables="\n".join([time, *lines]),
        structure="\n".join(structure), units=_unit_definitions(c.units),
    )  # fmt: skip
    text = wrapper(
        name, kind, token, dt=step, ranges=", ".join(ranges), num_starts=len(values), num_inputs=len(c.input_values),
        starts=", ".join(number(dtype(x)) for x in [*values, 0]),
        inputs=", ".join(number(dtype(x)) for x in [*c.input_values, 0]),
        places="\n".join(f"    case {i}: return &{place};" for i, place in enumerate(places)),
        arguments=_arguments(starts, c),
    )  # fmt: skip
    return ExportedFMU(c, description, text)


def _unit_definitions(units):
    """The XML definitions of all units that occur."""
    names = "".join(f"\n    <Unit name={quoteattr(text)}/>" for text in sorted(set(units.values())))
    return f"\n  <UnitDefinitions>{names}\n  </UnitDefinitions>" if names else ""


def _of_xml(x):
    """A number as text in XML Schema."""
    return {"inf": "INF", "-inf": "-INF", "nan": "NaN"}.get(repr(x), repr(x))


def _named(*groups):
    """Pairs of each field and one with the name of its variable. All names are different, and none is "time"."""
    names = iter(distinct([*chain(*groups)], taken=["time"]))
    return [[(field, next(names)) for field in group] for group in groups]


def _variables(kind, found, struct, attributes, values, units, array=None):
    """(element of the description, place in C) of each number.

    found: from `_named`. array: name of an array that holds the numbers, instead of a struct.
    """
    rows = []
    for field, named in found:
        for i, place in enumerate(field.places(struct or "")):
            index = f"[{','.join(str(j + 1) for j in np.unravel_index(i, field.shape))}]" if field.shape else ""
            start = "" if values is None else f' start="{_of_xml(float(values[len(rows)]))}"'
            label = quoteattr(f"{named.name}{index}")
            if unit := units.get(field.name):
                start += f" unit={quoteattr(unit).replace('{', '{{').replace('}', '}}')}"
            text = f'    <{kind} name={label} valueReference="{{reference}}" {attributes}{start}/>'
            rows.append((text, place if array is None else f"{array}[{len(rows)}]"))
    return rows


def _arguments(starts, c):
    """The arguments of NAME_init between params and t0."""
    first, words = 0, []
    for _, tree in starts:
        words.append(f"m->start + {first}, ")
        first += sum(np.size(x) for x in jax.tree.leaves(tree))
    return "".join([*words, *["m->u, "] * bool(c.inputs)])
