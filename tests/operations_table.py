"""Expressions of every operation that hhtjax/xla has a rule for, with its options, for test_conformance.py.

Each is Python in variables of `ARGUMENTS`; those it names are arguments of the traced function.
Sums of negative zeros are not among them: plain JAX gives 0 by itself and -0 compiled.
"""

import numpy as np

# ruff: noqa: E501

NAN, INF = np.nan, np.inf
ARGUMENTS = {
    "s": np.array(0.7),
    "t": np.array(-1.3),
    "x": np.array([0.7, -1.3, 0.4]),
    "y": np.array([1.2, 0.3, -0.8]),
    "X": np.array([[0.7, -1.3, 0.4], [0.2, 1.1, -0.6]]),
    "S": np.array([[2.0, 0.3, -0.1], [0.4, 1.5, 0.2], [-0.3, 0.1, 1.1]]),
    "C": np.linspace(-1.2, 1.3, 8).reshape(2, 2, 2),
    "E": np.zeros((2, 0)),
    "e": np.zeros(0),
    "l": np.linspace(-1.0, 2.0, 70),  # larger than what is taken to pieces
    "z": np.array([NAN, INF, -INF, 0.0, -0.0, 1.0, -1.0, 2.5, -0.3]),
    "w": np.array([0.0, -0.0, 1.0, -1.0, NAN, INF, -INF, 0.5, 3.0]),
    "g": np.array([0.7, -1.3, 0.4], np.float32),
    "i": np.array([2, 0, -1], np.int32),
    "j": np.array([5, -7, 3], np.int32),
    "o": np.array([0, 1, 0], np.int32),
    "m": np.array([7, -4, 0], np.int64),
    "n": np.array(1, np.int32),
    "p": np.array(9, np.int32),
    "q": np.array(-2, np.int32),
    "b": np.array([True, False, True]),
    "c": np.array([False, False, True]),
    "d": np.array(True),
}

FUNCTIONS = "sin cos tan sinh cosh tanh asin acos atan asinh acosh atanh exp exp2 expm1 log log1p sqrt rsqrt cbrt"
OTHERS = "abs neg sign floor ceil square erf logistic stop_gradient is_finite reciprocal"
ROUNDINGS = ("AWAY_FROM_ZERO", "TO_NEAREST_EVEN")
CONSTANTS = ("0.0", "-0.0", "1.0", "-1.0", "2.0", "jnp.inf", "-jnp.inf", "jnp.nan")
# where the machinery may know what one operand is
WITH_CONSTANTS = [f"{a} {o} {b}" for o in "+-*/" for k in CONSTANTS for a, b in (("z", k), (k, "z"))]
AT = ("np.array([2, 0, 2])", "np.array([1, 5, -1])", "np.array([-4, 3, 9])", "i", "n", "p", "q", "1", "np.array([], int)")
HOW = ("mode='clip'", "mode='drop'", "mode='fill'")
SURE = "mode='promise_in_bounds', indices_are_sorted=True, unique_indices=True"

TABLE = {
    "of one number": [
        *(f"lax.{f}({a})" for f in f"{FUNCTIONS} {OTHERS}".split() for a in "xz"),
        *(f"lax.round({a}, lax.RoundingMethod.{r})" for a in ("4 * x", "z") for r in ROUNDINGS),
        *("lax.round(np.array([0.5, 1.5, -0.5]) + 0 * x, lax.RoundingMethod.TO_NEAREST_EVEN)", "jnp.copy(x)", "-x", "~b"),
        *("lax.abs(j)", "lax.neg(j)", "lax.sign(j)", "lax.sign(z) / 0.0", "~j", "lax.reduce_precision(x, 11, 52)"),
        *(f"lax.integer_pow({a}, {n})" for a in "xzj" for n in (0, 1, 2, 3, 5)),
        *("lax.integer_pow(z, -1)", "lax.integer_pow(x, -3)", "lax.population_count(j)", "lax.clz(j)", "lax.sin(g)"),
        *("lax.exp(x, accuracy=lax.Tolerance(1e-3))", "lax.sin(x, accuracy=lax.AccuracyMode.HIGHEST)"),
    ],
    "of two": [
        *(f"lax.{f}({a}, {b})" for f in ("add", "sub", "mul", "div", "max", "min", "atan2", "pow", "rem", "nextafter")
          for a, b in ("xy", "zw", "wz")),
        *(f"lax.{f}({a}, {b})" for f in ("div", "rem", "max", "min", "mul", "sub") for a, b in ("ji", "jo", "mm")),
        *(f"lax.{f}(j, lax.abs(i))" for f in ("shift_left", "shift_right_logical", "shift_right_arithmetic")),
        *(f"{a} {o} {b}" for o in "&|^" for a, b in ("ij", "bc")),
        *(f"lax.{f}({a}, {b})" for f in ("eq", "ne", "lt", "le", "gt", "ge") for a, b in ("xy", "zw", "ij", "bc")),
        *(f"x ** {k}" for k in ("2", "0", "0.5", "3.0", "y", "-1")),
        *("0.0 ** z", "z ** 0.0", "1.0 ** z", "z ** 1.0", "2 ** n", "z ** n", "x ** s", "s ** t", "abs(x) ** y"),
        *WITH_CONSTANTS,
        *("j * 0", "0 * j", "j + 0", "0 - j", "j / 1", "j // 1", "j * 1", "b & True", "b | False", "i - i", "x - x"),
        *("np.array([1.0, 0.0, 1.0]) * lax.sqrt(x)", "jnp.arctan2(np.zeros(3) - w[:3], -jnp.ones(3))", "z * z - z * z"),
        *("lax.max(z, np.full(9, -0.0))", "lax.min(0.0 * w, w)", "lax.max(jnp.zeros(9), z)", "lax.min(z, jnp.nan)"),
        *("lax.mul(g, g)", "lax.add(g, np.float32(0))", "x + s", "jnp.hypot(x, y)", "lax.nextafter(x, np.zeros(3))"),
    ],
    "of more": [
        *(f"lax.select_n({b}, {x}, {y})" for b, x, y in (("b", "x", "y"), ("d", "x", "y"), ("b", "i", "j"), ("d", "s", "t"))),
        *("lax.select_n(np.array([True, False, True]), x, y)", "lax.select_n(np.array([0, 2, 1], np.int32), x, y, 2 * x)"),
        *("lax.select_n(lax.abs(i), x, y, -x)", "lax.select_n(n, x, y, -x)", "jnp.where(b, x, jnp.nan)"),
        *("jnp.where(x > 0, jnp.sqrt(x), 0.0)", "jnp.where(b, 0.0, x)", "lax.select_n(b, b, c)", "jnp.where(d, z, w)"),
        *("lax.clamp(-0.5, x, 0.5)", "lax.clamp(0.5, x, -0.5)", "lax.clamp(t, x, s)", "lax.clamp(y, x, y + 1)"),
        *("lax.clamp(0.0, z, 1.0)", "lax.clamp(jnp.nan, z, 1.0)", "lax.clamp(np.int32(0), j, np.int32(4))"),
        *("lax.clamp(-0.0, z, 0.0)", "jnp.clip(z, -0.0, jnp.inf)"),
    ],
    "types": [
        *(f"{a}.astype({t})" for a in "xijbgz" for t in ("jnp.float64", "jnp.float32", "bool")),
        *(f"{a}.astype({t})" for a in "xijbg" for t in ("jnp.int32", "jnp.int64")),
        *("(1e10 * x).astype(jnp.int32)", "z.astype(jnp.int32)", "jnp.asarray(jnp.nan).astype(jnp.int32) + n"),
        *("lax.iota(jnp.int32, 3) * j", "lax.iota(float, 3) * x", "lax.broadcasted_iota(jnp.float32, (2, 3), 1) * g"),
        *("lax.broadcasted_iota(int, (2, 3), 0) + m", "jnp.arange(3.0) * x", "lax.bitcast_convert_type(x, int)"),
    ],
    "shapes": [
        *("X.reshape(3, 2)", "lax.reshape(X, (6,), dimensions=(1, 0))", "lax.reshape(C, (4, 2), dimensions=(2, 0, 1))"),
        *("X.ravel(order='F')", "X.reshape(3, 2, order='F')", "C.ravel(order='F')", "X.reshape(1, 6, 1)", "s.reshape(1, 1)"),
        *("jnp.squeeze(X[:1])", "lax.expand_dims(x, (0, 2))", "x[:1].reshape(())", "E.reshape(0, 5)", "l.reshape(7, 10).T.ravel()"),
        *("lax.transpose(C, (2, 0, 1))", "X.T", "E.T", "i.reshape(3, 1).T", "S.T", "lax.transpose(s, ())"),
        *("lax.broadcast_in_dim(x, (2, 3), (1,))", "lax.broadcast_in_dim(X, (2, 4, 3), (0, 2))", "lax.broadcast(s, (3,))"),
        *("lax.broadcast_in_dim(X[:1], (2, 3), (0, 1))", "jnp.broadcast_to(x, (0, 3))", "jnp.broadcast_to(b, (2, 3))"),
        *("lax.rev(X, (1,))", "lax.rev(C, (0, 2))", "lax.rev(x, ())", "x[::-1]", "lax.rev(e, (0,))", "X[:, ::-2]"),
        *("lax.concatenate([x, y, x[:1]], 0)", "lax.concatenate([x, e], 0)", "lax.concatenate([e, e], 0)"),
        *("lax.concatenate([X, S, X], 0)", "lax.concatenate([X, X[:, :0], X[:, :1]], 1)", "lax.concatenate([i, j], 0)"),
        *("lax.concatenate([e], 0)", "jnp.concatenate([l, x])", "jnp.stack([x, y], 1)", "jnp.stack([s, t, s])"),
        *("jnp.stack([i, j])", "jnp.stack([e, e])", "lax.split(x, (1, 0, 2))", "lax.split(X, (2, 1), 1)", "jnp.split(i, 3)"),
        *("lax.split(l, (30, 40))", "jnp.tile(x, (2, 1))", "jnp.repeat(x, 2)", "jnp.roll(x, 1)", "jnp.roll(X, -1, 1)"),
        *("lax.slice(x, (1,), (3,))", "lax.slice(X, (0, 0), (2, 3), (1, 2))", "lax.slice(X, (1, 1), (1, 3))", "l[::9]"),
        *("lax.slice(C, (0, 1, 0), (2, 2, 2), (2, 1, 1))", "x[-2:]", "X[1]", "X[..., None, 1]", "l[3:60:7]", "s[None]"),
        *("lax.pad(x, 0.0, [(1, 2, 0)])", "lax.pad(x, 1.5, [(-1, 2, 1)])", "lax.pad(x, s, [(1, -1, 2)])"),
        *("lax.pad(X, 0.0, [(-1, 0, 0), (0, -2, 1)])", "lax.pad(x, -0.0, [(0, 0, 1)])", "lax.pad(x, jnp.nan, [(1, 0, 0)])"),
        *("lax.pad(x, s, [(-3, 1, 0)])", "lax.pad(e, s, [(1, 1, 3)])", "lax.pad(j, n, [(1, 1, 1)])", "lax.pad(b, d, [(1, 0, 0)])"),
        *("lax.pad(x, s, [(-2, -2, 1)])", "jnp.pad(x, 1, mode='wrap')", "jnp.pad(x, 2, mode='reflect')", "lax.pad(l, s, [(1, 1, 0)])"),
        *("jnp.diag(x)", "jnp.triu(S)", "jnp.tril(S, -1)", "jnp.diff(x, prepend=0)", "jnp.kron(x, y)", "jnp.eye(3) * s"),
    ],
    "places": [
        *(f"x[{at}]" for at in ("np.array([2, 0, 2])", "np.array([-1, -3])", "1", "-1", "o", "n", "np.array([], int)")),
        *(f"x.at[{at}].get({how})" for at in AT for how in ("mode='clip'", "mode='fill'")),
        *(f"x.at[{at}].get(mode='fill', fill_value={v})" for at in AT[:5] for v in ("0.0", "1.0", "-0.0", "jnp.nan", "2.5")),
        *("x.at[np.array([0, 2])].get(mode='promise_in_bounds')", f"x.at[np.array([0, 2])].get({SURE})", "i[np.array([0, 2])]"),
        *("i.at[np.array([0, 7])].get(mode='fill', fill_value=-5)", "i.at[np.array([0, 7])].get(mode='fill')", "b[o]"),
        *("b.at[np.array([1, 4])].get(mode='fill')", "b.at[np.array([1, 4])].get(mode='fill', fill_value=False)"),
        *("X[:, np.array([2, 0])]", "X[np.array([1, 0]), np.array([2, 2])]", "X[o, 1]", "X.at[n, i].get(mode='clip')"),
        *("C[1, :, np.array([0, 1, 1])]", "jnp.take(X, i, axis=1, mode='clip')", "X[np.array([[0, 1], [1, 1]])]"),
        *("jnp.take_along_axis(X, jnp.argsort(X, axis=1), axis=1)", "X.at[3, 1:].get(mode='fill', fill_value=7.0)"),
        *("x[np.array([True, False, True])]", "l[np.array([3, 69])]", "z[np.array([0, 3, 4, 1])]"),
        *(f"x.at[{at}].set({v})" for at in AT for v in ("3.0", "s")),
        *(f"x.at[{at}].{f}(2.0)" for at in AT[:7] for f in ("add", "min", "max", "subtract", "divide")),
        *(f"x.at[{at}].multiply(2.0, unique_indices=True)" for at in ("np.array([1, 5])", "i[:2]", "n")),
        *(f"x.at[{at}].set(y[:1], {how})" for at in AT[1:3] for how in HOW),
        *(f"x.at[{at}].add(y[:1], {how})" for at in AT[1:4] for how in HOW),
        *("x.at[1].apply(jnp.sin)", "x.at[np.array([0, 0, 2])].apply(jnp.sin)", "x.at[i].apply(jnp.exp)", "x.at[n].power(2)"),
        *(f"x.at[np.array([0, 2])].{f}(y[:2], {SURE})" for f in ("set", "add", "multiply", "min", "max")),
        *("x.at[np.array([2, 2, 0])].set(y)", "x.at[np.array([2, 2, 0])].add(y)", "X.at[:, 1].set(y[:2])", "X.at[1].add(x)"),
        *("X.at[0, np.array([0, 2])].multiply(y[:2], unique_indices=True)", "jnp.zeros(5).at[np.array([1, 1, 3])].set(x)"),
        *("i.at[1].set(7)", "b.at[1].set(True)", "i.at[np.array([0, 0])].add(3)", "z.at[3].set(-0.0)", "e.at[i].set(1.0)"),
        *("S.at[np.diag_indices(3)].set(x)", "S.at[np.array([0, 1]), np.array([1, 2])].add(s)", "l.at[i].set(0.0)"),
        *("lax.dynamic_slice(x, (1,), (2,))", "lax.dynamic_slice(x, (n,), (2,))", "lax.dynamic_slice(x, (p,), (2,))"),
        *("lax.dynamic_slice(X, (q, np.int32(2)), (1, 2))", "lax.pow(x, i)", "lax.pow(z, 2)", "lax.dynamic_slice(X, (0, 5), (2, 2))", "lax.dynamic_slice(x, (-9,), (1,))"),
        *("lax.dynamic_slice(e, (n,), (0,))", "lax.dynamic_slice(i, (1,), (2,))", "lax.dynamic_index_in_dim(X, n, 1)", "x[n]"),
        *("lax.dynamic_update_slice(x, y[:2], (2,))", "lax.dynamic_update_slice(x, y[:2], (n,))"),
        *("lax.dynamic_update_slice(X, S[:1, :2], (p, q))", "lax.dynamic_update_slice(i, j[:1], (2,))", "x.at[n].set(s)"),
        *("lax.dynamic_update_slice(x, e, (1,))", "lax.dynamic_slice(x, (-1,), (2,))", "lax.dynamic_slice(l, (n,), (3,))"),
        *("lax.dynamic_update_slice(b, c[:1], (1,))", "lax.dynamic_update_slice(x, y, (0,))"),
    ],
    "sums": [
        *(f"jnp.{f}({a})" for f in ("sum", "prod", "max", "min", "any", "all", "mean") for a in ("x", "X", "z", "s")),
        *(f"jnp.{f}({a})" for f in ("sum", "prod", "max", "min", "any", "all") for a in "ijb"),
        *(f"jnp.{f}(C, axis={a})" for f in ("sum", "prod", "max", "min") for a in ("0", "(0, 2)", "()", "-1")),
        *("jnp.sum(e)", "jnp.prod(e)", "jnp.sum(E, axis=1)", "jnp.sum(E, axis=0)", "jnp.all(E > 0)", "jnp.any(e > 0)"),
        *("jnp.max(E, axis=0)", "jnp.max(x, initial=9.0)", "jnp.min(X, axis=1, keepdims=True)", "jnp.sum(x, where=b)"),
        *("jnp.sum(x, dtype=jnp.float32)", "jnp.max(0.0 * w[:4])", "jnp.min(0 * w[:4])"),
        *("jnp.max(s * np.ones(3))", "jnp.min(s * np.array([3.0, 1.0, 1.0, 1.0]))", "jnp.max(s * np.ones((2, 3)), axis=0)"),
        *("jnp.prod(0.0 * x)", "jnp.prod(x[:1] * np.array([1.0, 0.0, 2.0]))", "jnp.linalg.norm(0.0 * x + s)", "lax.max(x, x)"),
        *("lax.reduce_and(j, (0,))", "lax.reduce_or(j, (0,))", "lax.reduce_xor(j, (0,))", "lax.reduce_and(b, (0,))", "jnp.sum(l)"),
        *("lax.reduce(x, 0.5, lax.add, (0,))", "lax.reduce(X, 1.0, lambda a, b: a * b + a, (1,))", "lax.reduce_or(b, ())"),
        *("jnp.argmax(x)", "jnp.argmin(X, axis=1)", "jnp.argmax(z)", "lax.argmax(x, 0, jnp.int32)", "jnp.argmax(b)"),
        *("jnp.linalg.norm(x)", "jnp.var(x)", "jnp.cumsum(x)", "lax.cumsum(X, 1, reverse=True)", "jnp.cumprod(x)"),
        *("lax.cummax(x)", "lax.cummin(x, reverse=True)", "lax.cumlogsumexp(x)", "jnp.sort(x)", "jnp.argsort(x)", "jnp.sort(z)"),
        *("jnp.sort(X, axis=0)", "jnp.median(x)", "jnp.trace(S)", "jnp.interp(x, jnp.linspace(-2.0, 2.0, 9), jnp.arange(9.0) ** 2)"),
        *("lax.top_k(x, 2)", "jnp.searchsorted(l, x)", "jnp.convolve(x, y)"),
    ],
    "products": [
        *("x @ y", "S @ x", "x @ S", "S @ S", "X @ S", "S @ X.T", "jnp.outer(x, y)", "jnp.cross(x, y)", "C @ C", "E @ E.T"),
        *("X[:, :0] @ S[:0]", "jnp.einsum('bij,bjk->bik', C, C)", "jnp.einsum('ij,j,k->ik', X, x, y)", "jnp.einsum('ii', S)"),
        *("jnp.einsum('ij,ij->j', X, X)", "jnp.einsum('ijk,ijl->kl', C, C)", "jnp.tensordot(C, C, 2)", "jnp.vdot(X, X)"),
        *("lax.dot_general(C, C, (((2,), (1,)), ((0,), (0,))))", "lax.dot_general(C, C, (((), ()), ((0, 2), (0, 2))))"),
        *("lax.dot_general(x, y, (((0,), (0,)), ((), ())), precision='highest')", "lax.dot_general(x, y, (((), ()), ((0,), (0,))))"),
        *("lax.dot_general(g, g, (((0,), (0,)), ((), ())), preferred_element_type=jnp.float64)", "jnp.dot(i, j)", "jnp.dot(g, g)"),
        *("lax.dot_general(i, j, (((0,), (0,)), ((), ())), preferred_element_type=jnp.int64)", "jnp.outer(i, j)"),
        *("lax.dot_general(X, S, (((1,), (0,)), ((), ())), precision=lax.Precision.HIGHEST)", "lax.dot(x, i)", "b.astype(int) @ m"),
        *("lax.dot_general(x, y, (((0,), (0,)), ((), ())), precision=lax.DotAlgorithmPreset.F64_F64_F64)",),
        *("jnp.eye(3) @ x", "np.array([[0.0, 2.0, 0.0]]) @ z[:3]", "np.eye(9) @ z", "np.array([1.0, 0.0]) @ w[3:5]"),
        *("np.array([[1.0, -0.0], [0.0, 1.0]]) @ z[3:5]", "jnp.zeros((3, 3)) @ x", "l @ l"),
    ],
    "functions": [
        *("lax.cond(d, lambda x: x * x, lambda x: -x, x)", "lax.cond(x[0] > 0, jnp.sin, jnp.cos, x)", "lax.cond(True, jnp.sin, jnp.cos, x)"),
        *(f"lax.switch({k}, [jnp.sin, jnp.cos, jnp.negative], x)" for k in ("n", "p", "q", "1")),
        *("lax.switch(n, [lambda x: (x[:0], i), lambda x: (x[1:1], j)], x)", "lax.cond(d, lambda: E, lambda: E + 1)"),
        *("lax.fori_loop(0, 3, lambda k, x: x * s + k, x)", "lax.fori_loop(0, n, lambda k, x: jnp.sin(x) + k * y, x)"),
        *("lax.fori_loop(q, p, lambda k, x: x + 0.1 * k, x)", "lax.fori_loop(0, 0, lambda k, x: -x, x)"),
        *("lax.while_loop(lambda c: c[0] < n + 2, lambda c: (c[0] + 1, jnp.cos(c[1])), (0, x))",),
        *("lax.while_loop(lambda v: jnp.any(jnp.abs(v * v - s) > 1e-3), lambda v: (v + s / v) / 2, 1 + x * x)",),
        *("lax.while_loop(lambda v: v[0] < 3, lambda v: v + lax.abs(y) + 1, x)", "lax.while_loop(lambda c: False, lambda c: c, x)"),
        *("lax.scan(lambda a, r: (a + r, a * r), s, x)", "lax.scan(lambda a, r: (a * r @ x, r), s, X, reverse=True)"),
        *("lax.scan(lambda a, _: (jnp.sin(a), None), x, None, length=3)", "lax.map(lambda r: r @ x, X)", "lax.scan(lambda a, r: (a, r), x, e)"),
        *("steep(x)", "steep(x) * x", "steep(s)", "flat(x)", "flat(s) * s", "jax.nn.relu(x)", "jax.nn.softplus(x)", "jax.nn.silu(X)"),
        *("jax.jit(lambda x, y: (x @ y, y))(x, y)", "jax.jit(jax.jit(lambda x: x[::-1]))(x)", "jax.jit(lambda: np.arange(3.0))() * x"),
        *("jax.checkpoint(lambda x: jnp.sin(x) * y)(x)", "jax.vmap(jnp.dot, (0, None))(X, x)", "jax.vmap(lambda k: x[k])(i)"),
        *("jax.vmap(lambda k: lax.fori_loop(0, k, lambda _, v: v * 1.1, s))(i)", "jax.grad(lambda x: jnp.sum(jnp.sin(x) * y))(x)"),
        *("jax.jvp(jnp.sin, (x,), (y,))", "jax.jacfwd(lambda x: S @ (x * x))(x)", "jax.hessian(lambda x: jnp.prod(x))(x)"),
        *("lax.custom_linear_solve(lambda v: S @ v, x, lambda _, b: jnp.linalg.solve(S, b), lambda _, b: jnp.linalg.solve(S.T, b))",),
        *("lax.custom_linear_solve(lambda v: 2 * v, x, lambda f, b: b / 2)", "lax.custom_linear_solve(lambda v: s * v, x,"
          " lambda f, b: b / s, symmetric=True)", "jnp.linalg.solve(S, x)", "jnp.linalg.inv(S)", "jnp.linalg.det(S)"),
        *("jax.scipy.sparse.linalg.cg(lambda v: (S + S.T) @ v, x)[0]", "jnp.linalg.cholesky(S + S.T)", "lax.stop_gradient(x) * x"),
        *("staged(lambda x, y: (x, jnp.sin(x - y), y))(x, y)", "staged(lambda x: structural(np.eye(3)) @ x)(x)", "lax.optimization_barrier(x)"),
        *("structural(np.array([0.0, 1.0, 0.0])) * x + y", "jax.pure_callback(np.sin, x, x, vmap_method='sequential')"),
        *("jax.nn.one_hot(i, 3) @ x", "lax.convert_element_type(structural(np.zeros(3)), float) - x", "jnp.vectorize(lambda a: a * s)(x)"),
    ],
}  # fmt: skip
