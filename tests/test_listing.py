"""Every operation with a rule, with its options, in C: the numbers of NumPy, NaN, infinities and zeros included."""

import ctypes
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from by_numpy import Numbers, is_close
from columns import traced, value
from compiled_c import compiled, needs_compiler
from operations_table import TABLE
from program_writer import usual_promotion
from test_conformance import expression

from hhtjax.export.statements import NotWritten, Statements, helper
from hhtjax.jaxpr import NotListed, Scalar, listed

pytestmark = [needs_compiler, pytest.mark.filterwarnings("ignore")]
# what has no counterpart in C, or none yet; with options that are not understood; a loop that vmap has made of several
REFUSED = {
    *("bitcast_convert_type", "cholesky", "clz", "conv_general_dilated", "cumlogsumexp", "cummax", "cummin"),
    *("dot_general", "dynamic_update_slice", "exp", "population_count", "pure_callback", "reduce"),
    *("reduce_precision", "reduce_xor", "scatter", "scatter-add", "scatter-max", "scatter-min", "scatter-mul"),
    *("scatter-sub", "shift_left", "shift_right_arithmetic", "shift_right_logical", "sin", "sort", "top_k"),
    *("hhtjax_in_turn", "while"),
}


class Written:
    """An expression as a function of C: `void f0(double *out)`, its arguments numbers in the text."""

    def __init__(self, number, f, arguments):
        self.listing = listed(f, *arguments)
        operands = [x for array in jax.tree.leaves(self.listing.results) for x in np.ravel(array)]
        numbers = [x for argument in arguments for x in np.ravel(argument)]
        text = Statements({}, "m", (np.dtype(float), "double"))
        names = dict(zip(self.listing.arguments, numbers, strict=True))
        for i, (scalar, x) in enumerate(names.items()):
            text.names[scalar] = f"argument{i}"
            of_c = text.type(np.dtype(scalar.dtype))
            text.line(f"volatile {of_c} given{i} = {text.text(x)}; const {of_c} argument{i} = given{i};")
            text.line(f"(void)argument{i};")
        text.write(self.listing.operations)
        for i, x in enumerate(operands):
            text.line(f"out[{i}] = (double)({text.text(x)});")
        self.size, self.helpers = len(operands), text.helpers
        self.text = f"void f{number}(double *out)\n{{\n    (void)out;\n" + "\n".join(text.lines) + "\n}\n"


def written(group):
    """{text: `Written`}, and {text: the operation that is refused}."""
    found, refused = {}, {}
    for text in dict.fromkeys(TABLE[group]):
        try:
            found[text] = Written(len(found), *expression(text))
        except (NotListed, NotWritten) as error:
            refused[text] = getattr(error, "name", str(error))
    return found, refused


@pytest.mark.slow
@pytest.mark.parametrize("group", TABLE)
def test_c_computes_what_numpy_does(group, tmp_path):
    with usual_promotion(), np.errstate(all="ignore"):
        found, refused = written(group)
        helpers = sorted({x for f in found.values() for x in f.helpers}, key=str)
        parts = ["#include <math.h>\n#include <stdint.h>\n#include <string.h>\n"]
        parts += [helper(name, "m", dtype) for name, dtype in helpers] + [f.text for f in found.values()]
        (tmp_path / "all.c").write_text("\n".join(parts))
        library = ctypes.CDLL(str(compiled([tmp_path / "all.c"], tmp_path / "all.so", "-O1", "-fPIC", "-shared")))
        wrong = []
        for number, (text, f) in enumerate(found.items()):
            function, arguments = expression(text)
            out = (ctypes.c_double * max(f.size, 1))()
            getattr(library, f"f{number}")(out)
            expected = Numbers()(traced(value(function), arguments)[0], *arguments)
            expected = np.concatenate([np.ravel(x).astype(float) for x in expected] or [np.zeros(0)])
            ours = np.array(out[: f.size])
            if not is_close(ours, expected, 1e-6 if "g" in text else 1e-13):
                wrong.append(f"{text}: {ours}, not {expected}")
    assert not wrong, "\n".join(wrong)
    assert set(refused.values()) <= REFUSED
    assert len(found) > 2 * len(refused)


def test_singular_values_in_c(tmp_path):
    """Of full rank and not, up to 25: what they multiply to, orthogonal, falling, and NumPy's."""
    text = helper("svd", "m", np.float64).replace("static ", "")
    text = text.replace("{", ";\n" + text[text.index("void") : text.index("{")] + "{", 1)  # declared before
    (tmp_path / "svd.c").write_text(f"#include <math.h>\n{text}\n")
    library = ctypes.CDLL(str(compiled([tmp_path / "svd.c"], tmp_path / "svd.so", "-O1", "-fPIC", "-shared")))
    rng = np.random.default_rng(0)
    for n, rank in ((1, 1), (2, 1), (4, 2), (5, 5), (8, 0), (12, 9), (25, 25)):
        A = rng.standard_normal((n, rank)) @ rng.standard_normal((rank, n))
        for k in range(3):
            if k and n > 2:
                A[:, 1] = A[:, 0] if k == 1 else 0
            S, U, V = np.zeros(n), np.zeros((n, n)), np.zeros((n, n))
            library.m_svd(n, *(x.ctypes.data_as(ctypes.c_void_p) for x in (A, S, U, V)))
            for ours, expected in ((U * S @ V, A), (U.T @ U, np.eye(n)), (V @ V.T, np.eye(n))):
                np.testing.assert_allclose(ours, expected, atol=1e-13 * n)
            np.testing.assert_allclose(S, np.linalg.svd(A)[1], atol=1e-13 * n)


@pytest.mark.slow
def test_large_products_in_c_whatever_is_summed(tmp_path):
    """As loops: over either axis of either matrix, of constants and of what a loop has computed, and with vectors."""
    rng = np.random.default_rng(0)
    sides = (rng.standard_normal((24, 20)), 1), (rng.standard_normal((20, 24)), 0)  # the axis of 20 is summed
    others = (rng.standard_normal((20, 2)), 0), (rng.standard_normal((2, 20)), 1), (rng.standard_normal(20), 0)

    def products(x):
        found = []
        for (A, i), (B, j) in product(sides, others):
            for y, z in ((A, x * B), (x * A, B)):
                found.append(jnp.tensordot(y, z, (i, j)))
        return jnp.concatenate([jnp.ravel(y) for y in found])

    f = Written(0, products, (np.float64(1.5),))
    loops = [(x.params["rows"], x.params["columns"]) for x in f.listing.operations if x.name == "product"]
    assert {(24, 2), (24, 1)} == set(loops)
    (tmp_path / "f.c").write_text("#include <string.h>\n" + f.text)
    library = ctypes.CDLL(str(compiled([tmp_path / "f.c"], tmp_path / "f.so", "-O1", "-fPIC", "-shared")))
    out = np.zeros(f.size)
    library.f0(out.ctypes.data_as(ctypes.c_void_p))
    np.testing.assert_allclose(out, products(1.5), rtol=1e-13)


def test_each_operation_stands_once():
    found = listed(lambda x: (jnp.sin(x) * 2, 2 * jnp.sin(x), x * x, x**2, x + 0.0), jnp.ones(()))
    assert [x.name for x in found.operations] == ["sin", "mul", "mul"]


def test_long_loops_stay_loops():
    def repeated(count):
        return listed(lambda x: jax.lax.fori_loop(0, count, lambda i, x: jnp.sin(x) + jnp.cos(x[0]), x), jnp.ones(8))

    long, short = repeated(200), repeated(3)
    assert [x.name for x in long.operations] == ["while"]
    assert long.count()[1] == 9
    assert "while" not in {x.name for x in short.operations}
    assert short.count()[1] == 27


def test_what_nobody_needs_is_left_out():
    def loop(x):
        return jax.lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] * x, jnp.sin(c[2])), (0, x, x))[1]

    def either(x):
        return jax.lax.cond(x > 0, lambda x: (jnp.sin(x), x), lambda x: (jnp.cos(x), -x), x)[1]

    for f, names in ((loop, {"lt", "add", "mul"}), (either, {"gt", "neg"})):
        (operation,) = [x for x in listed(f, jnp.ones(())).operations if x.blocks]
        assert len(operation.results) == (2 if f is loop else 1)
        inner = {x.name for block in operation.blocks for x in block.operations}
        assert inner <= names | {"convert_element_type"}
        assert "sin" not in inner
    assert isinstance(listed(jnp.sin, jnp.ones(())).arguments[0], Scalar)
